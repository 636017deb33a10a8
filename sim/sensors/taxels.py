"""Simulate uSkin: magnets in silicone above Hall elements, with counts along three axes."""

import math
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from sim.arrays import Array
from sim.errors import SceneError, check_range
from sim.scene import Body
from sim.sensors.field import SurfaceField, cubic_weights

# Magnetic field of dipoles.

# Magnetic constant over 4 pi [T m / A], to nine digits.
MU_0_OVER_4_PI = 1e-7


def flux_density(moments: Array, magnets: Array, places: Array) -> Array:
    """Return the total flux density (..., h, 3) [T] of m dipoles at h places.

    B = mu0 / 4 pi (3 r (m . r) / r^5 - m / r^3), r from magnet to place (Jackson, Classical
    Electrodynamics, section 5.6). Moments (..., m, 3) are in [A m^2], magnets (..., m, 3) and
    places (h, 3) in [m].
    """
    apart = places[:, None, :] - magnets[..., None, :, :]
    distance = np.linalg.norm(apart, axis=-1, keepdims=True)
    moment = moments[..., None, :, :]
    along = (moment * apart).sum(axis=-1, keepdims=True)
    field: Array = (3 * apart * along / distance**5 - moment / distance**3).sum(axis=-2)
    return MU_0_OVER_4_PI * field


def rotations(gradient: Array) -> Array:
    """Return R (..., 3, 3) of F = R U, F = 1 + gradient: the rotation of a small rigid body."""
    left, _, right = np.linalg.svd(np.eye(3) + gradient)
    # For an inverted deformation the nearest orthogonal matrix would be a reflection.
    left[..., -1] *= np.sign(np.linalg.det(left @ right))[..., None]
    return np.asarray(left @ right)


# Displacement inside a bonded layer, from that of its top.

Waves = NDArray[np.complex128]

# Spacing of samples of the top [m]. Waves that it cannot resolve have decayed to a hundredth at
# 0.75 mm below the top.
STEP = 0.5e-3
# Padding on each side before the waves repeat, in thicknesses of the body. In the first thickness
# the displacement of the edge fades to zero.
MARGIN = 2.0


class Interior:
    """Displacement and its gradient at places inside a layer, linear in the top's displacement.

    The layer is flat, linear elastic, bonded to a rigid base and laterally unbounded. The
    displacement of its top is given; each of its waves decays downwards by the closed form of
    `_reach`. Small strains are assumed below the top only; the displacement of the top may come
    from a large-strain solver. Places are x and y (n, 2) [m], `depth` [m] below the undeformed top.
    """

    def __init__(self, body: Body, depth: float, places: Array) -> None:
        check_range("interior", "depth", depth, 0.0, body.thickness, unit="m")
        self._samples = []
        spacing = []
        self._axes: tuple[bytes, ...] = ()
        self._across: list[Array] = []
        for size in (body.size_x, body.size_y):
            period = size + 2 * MARGIN * body.thickness
            count = scipy.fft.next_fast_len(math.ceil(period / STEP), real=True)
            spacing.append(period / count)
            self._samples.append((np.arange(count) - (count - 1) / 2) * period / count)
        self._fade = [
            _fade(samples, size / 2, body.thickness)
            for samples, size in zip(self._samples, (body.size_x, body.size_y), strict=True)
        ]
        count_x, count_y = (len(samples) for samples in self._samples)
        self._kx = 2 * np.pi * np.fft.fftfreq(count_x, spacing[0])
        self._ky = 2 * np.pi * np.fft.rfftfreq(count_y, spacing[1])
        self._reach, self._slope = _reach(
            self._kx[:, None],
            self._ky[None, :],
            height=body.thickness - depth,
            thickness=body.thickness,
            poisson=body.poisson,
        )
        # A real transform omits half of the waves, which are conjugates of the others.
        weight = np.full(len(self._ky), 2.0)
        weight[0] = 1.0
        if count_y % 2 == 0:
            weight[-1] = 1.0
        start_x, start_y = (samples[0] for samples in self._samples)
        self._at_x = np.exp(1j * self._kx * (places[:, :1] - start_x)) / count_x
        self._at_y = np.exp(1j * self._ky * (places[:, 1:] - start_y)) * weight / count_y

    def at(self, top: SurfaceField) -> tuple[Array, Array]:
        """Return displacement (F, n, 3) [m] and gradient du_i / dx_j (F, n, 3, 3) at the places."""
        waves = self._waves(top)
        moved = np.einsum("ijkl,fjkl->fikl", self._reach, waves)
        risen = np.einsum("ijkl,fjkl->fikl", self._slope, waves)
        gradient = np.stack(
            [
                self._summed(moved, 1j * self._at_x * self._kx, self._at_y),
                self._summed(moved, self._at_x, 1j * self._at_y * self._ky),
                self._summed(risen, self._at_x, self._at_y),
            ],
            axis=-1,
        )
        return self._summed(moved, self._at_x, self._at_y), gradient

    def _waves(self, top: SurfaceField) -> Waves:
        """Return amplitudes (F, 3, kx, ky) of the top's displacement."""
        axes = (top.x.tobytes(), top.y.tobytes())
        if axes != self._axes:
            self._axes = axes
            self._across = [
                cubic_weights(axis, samples) * fade[:, None]
                for axis, samples, fade in zip(
                    (top.x, top.y), self._samples, self._fade, strict=True
                )
            ]
        across_x, across_y = self._across
        planes = np.moveaxis(top.displacement, 3, 1).astype(float)
        return np.asarray(scipy.fft.rfft2(across_x @ planes @ across_y.T))

    def _summed(self, waves: Waves, at_x: Waves, at_y: Waves) -> Array:
        """Return values (F, n, 3) of waves (F, 3, kx, ky) at the places."""
        lines = np.einsum("nk,fckl->fncl", at_x, waves, optimize=True)
        return np.asarray(np.einsum("fncl,nl->fnc", lines, at_y).real)


def _fade(samples: Array, half: float, width: float) -> Array:
    """Return factors (K,): 1 on the body, fading smoothly to 0 within `width` beside it."""
    beside = np.clip((np.abs(samples) - half) / width, 0.0, 1.0)
    return 0.5 + 0.5 * np.cos(np.pi * beside)


def _reach(
    kx: Array, ky: Array, *, height: float, thickness: float, poisson: float
) -> tuple[Waves, Waves]:
    """Return the transfer of the top's waves to `height` above the base, and its slope along z.

    Both are (3, 3, kx, ky). In a plane-strain wave along x, u_x = i U(s) exp(ikx),
    u_z = W(s) exp(ikx) with s the height above the base. Navier's equations and u = 0 at s = 0
    leave two unknowns S, D, which the displacement of the top determines:

        k U = S (kappa sinh q + q cosh q) + D q sinh q
        k W = S q sinh q + D (q cosh q - kappa sinh q),    q = k s, kappa = 3 - 4 nu.

    The component across the wave varies as sinh q. For k = 0 all are linear in s.
    `sim.layer.spectral` has the same solution in terms of the top's traction.
    """
    length = np.hypot(kx, ky)
    still = length == 0
    k = np.where(still, 1.0 / thickness, length)
    kappa = 3 - 4 * poisson
    here, here_slope = _plane_waves(k * height, kappa)
    top, _ = _plane_waves(k * thickness, kappa)
    whole = top[0, 0] * top[1, 1] - top[0, 1] * top[1, 0]
    back = np.array([[top[1, 1], -top[0, 1]], [-top[1, 0], top[0, 0]]]) / whole
    # All entries are divided by exp(q) to avoid overflow; this factor restores it.
    decay = np.exp(k * (height - thickness))
    plane = np.einsum("abkl,bckl->ackl", here, back) * decay
    plane_slope = np.einsum("abkl,bckl->ackl", here_slope, back) * decay * k
    scale = decay / -np.expm1(-2 * k * thickness)
    across = -np.expm1(-2 * k * height) * scale
    across_slope = (1 + np.exp(-2 * k * height)) * scale * k

    # For k = 0 the layer is sheared and compressed uniformly, so everything is linear in height.
    for values, slopes, fraction in (
        (plane[0, 0], plane_slope[0, 0], 1.0),
        (plane[1, 1], plane_slope[1, 1], 1.0),
        (plane[0, 1], plane_slope[0, 1], 0.0),
        (plane[1, 0], plane_slope[1, 0], 0.0),
        (across, across_slope, 1.0),
    ):
        values[still] = fraction * height / thickness
        slopes[still] = fraction / thickness
    cosine, sine = np.where(still, 1.0, kx / k), np.where(still, 0.0, ky / k)
    return (_turned(plane, across, cosine, sine), _turned(plane_slope, across_slope, cosine, sine))


def _plane_waves(q: Array, kappa: float) -> tuple[Array, Array]:
    """Return rows k U, k W, columns S, D (2, 2, ...), and slopes in q; both divided by exp(q)."""
    decay = np.exp(-2 * q)
    sinh, cosh = (1 - decay) / 2, (1 + decay) / 2
    values = np.array([[kappa * sinh + q * cosh, q * sinh], [q * sinh, q * cosh - kappa * sinh]])
    slopes = np.array(
        [
            [(kappa + 1) * cosh + q * sinh, sinh + q * cosh],
            [sinh + q * cosh, (1 - kappa) * cosh + q * sinh],
        ]
    )
    return values, slopes


def _turned(plane: Array, across: Array, cosine: Array, sine: Array) -> Waves:
    """Return the matrix (3, 3, ...) in x, y, z of a wave along (cosine, sine).

    Since u_along = i U, the two off-diagonal entries of the plane part become imaginary.
    """
    (along, from_normal), (to_normal, normal) = plane
    mixed = (along - across) * cosine * sine
    return np.array(
        [
            [along * cosine**2 + across * sine**2 + 0j, mixed + 0j, 1j * from_normal * cosine],
            [mixed + 0j, along * sine**2 + across * cosine**2 + 0j, 1j * from_normal * sine],
            [-1j * to_normal * cosine, -1j * to_normal * sine, normal + 0j],
        ]
    )


Counts = NDArray[np.int32]

# Largest raw count: the device reports unsigned 16-bit values.
COUNT_MAX = 65535


@dataclass(frozen=True, slots=True)
class TaxelSignal:
    """Pad of rows and columns of magnets, each above its own Hall element.

    Taxel i is at column i % columns, row i // columns; columns go along x and rows along y, both
    ascending from the corner of least x and y. At rest, a magnet's moment points along z, out of
    the pad.

    Raises:
        SceneError: A value is out of range.
    """

    KIND: ClassVar[str] = "taxels"

    pitch: float = field(metadata={"unit": "mm"})
    """Distance between neighbouring taxels [m]."""
    magnet_depth: float = field(metadata={"unit": "mm"})
    """Depth of a magnet's middle below the undeformed top [m]."""
    hall_depth: float = field(metadata={"unit": "mm"})
    """Depth of the Hall elements below the base of the silicone [m]."""
    moment: float = field(metadata={"unit": "ma_m2"})
    """Magnetic moment of a magnet [A m^2]."""
    gain_shear: float = field(metadata={"unit": "counts_per_mt"})
    """Counts per flux density along x and y [1/T]."""
    gain_normal: float = field(metadata={"unit": "counts_per_mt"})
    """Counts per flux density along z [1/T]."""
    rest: tuple[float, float, float] = (48_000.0, 16_500.0, 40_000.0)
    """Raw counts of an unloaded taxel along x, y, z; they determine the range to saturation."""
    noise: float = 0.0
    """Standard deviation of a count; 0 is no noise."""
    rows: int = field(default=4, metadata={"stored": "unless default"})
    """Taxels along y, 1 to 32."""
    columns: int = field(default=4, metadata={"stored": "unless default"})
    """Taxels along x, 1 to 32."""

    def __post_init__(self) -> None:
        for name in ("rows", "columns"):
            check_range("taxels", name, getattr(self, name), 1, 32)
        for name, unit, low, high in (
            ("pitch", "m", 1e-4, 0.1),
            ("magnet_depth", "m", 0.0, 0.1),
            ("hall_depth", "m", 1e-4, 0.1),
            ("moment", "A m^2", 1e-9, 1.0),
            ("gain_shear", "1/T", 0.0, 1e10),
            ("gain_normal", "1/T", 0.0, 1e10),
            ("noise", "", 0.0, 1e4),
        ):
            check_range("taxels", name, getattr(self, name), low, high, unit=unit)
        if len(self.rest) != 3:
            raise SceneError(f"taxels.rest: {self.rest!r}; allowed: 3 counts")
        for index, value in enumerate(self.rest):
            check_range("taxels", f"rest[{index}]", value, 0.0, COUNT_MAX)

    @property
    def places(self) -> Array:
        """Positions of the taxels (n, 2) [m]."""
        number = np.arange(self.rows * self.columns)
        steps = np.stack([number % self.columns, number // self.columns], axis=1).astype(float)
        return np.asarray((steps - steps[-1] / 2) * self.pitch)


class TaxelPad:
    """Counts of a pad for a displacement of the silicone's top.

    A magnet moves and rotates with the material at its middle. Every Hall element measures the
    field of all magnets.

    Raises:
        SceneError: The body has a dome or is round, magnets are below the base, or taxels are
            outside the body.
    """

    def __init__(self, body: Body, signal: TaxelSignal) -> None:
        self.signal = signal
        if body.dome_radius is not None:
            raise SceneError(
                f"body.dome_radius: {body.dome_radius!r} m under taxels; allowed: None, a flat pad"
            )
        if body.footprint != "rectangle":
            raise SceneError(
                f"body.footprint: {body.footprint!r} under taxels; allowed: 'rectangle'"
            )
        if not signal.magnet_depth < body.thickness:
            raise SceneError(
                f"taxels.magnet_depth: {signal.magnet_depth!r} m; allowed: less than the body's "
                f"thickness, {body.thickness:g} m"
            )
        room = (body.size_x / (signal.columns - 1 or 1), body.size_y / (signal.rows - 1 or 1))
        if signal.pitch > min(room):
            raise SceneError(
                f"taxels.pitch: {signal.pitch!r} m; allowed: up to {min(room):g} m, so that the "
                "taxels lie in the body"
            )
        positions = signal.places
        self._interior = Interior(body, signal.magnet_depth, positions)
        self._magnets = _at_height(positions, -signal.magnet_depth)
        self._halls = _at_height(positions, -body.thickness - signal.hall_depth)
        still = np.zeros((1, len(positions), 3))
        self._undeformed = self.flux(still, np.zeros((*still.shape, 3)))[0]

    def flux(self, moved: Array, gradient: Array) -> Array:
        """Return the flux density (F, n, 3) [T] at the Hall elements.

        It is that of magnets moved by (F, n, 3) [m], with the gradient there (F, n, 3, 3), du_i /
        dx_j.
        """
        moments = self.signal.moment * rotations(gradient)[..., 2]
        return flux_density(moments, self._magnets + moved, self._halls)

    def change(self, top: SurfaceField) -> Array:
        """Return the change of the flux density (F, n, 3) [T] from that of the unloaded pad."""
        moved, gradient = self._interior.at(top)
        return np.asarray(self.flux(moved, gradient) - self._undeformed)

    def raw(self, top: SurfaceField, normal: Array | None = None) -> Counts:
        """Return raw counts (F, n, 3) as the device sends them: integers, saturated, 0 to 65535.

        The noise is given as standard normal numbers (F, n, 3); None for no noise.
        """
        signal = self.signal
        gain = np.array([signal.gain_shear, signal.gain_shear, signal.gain_normal])
        analog = np.array(signal.rest) + gain * self.change(top)
        if normal is not None:
            analog = analog + signal.noise * normal
        return np.clip(np.rint(analog), 0, COUNT_MAX).astype(np.int32)

    def counts(self, top: SurfaceField, normal: Array | None = None) -> Counts:
        """Return counts (F, n, 3) minus those of the unloaded pad, which are free of noise."""
        return self.raw(top, normal) - np.rint(self.signal.rest).astype(np.int32)


def _at_height(places: Array, height: float) -> Array:
    return np.column_stack([places, np.full(len(places), height)])
