"""Displacement of a bonded layer's top by tractions on it: convolutions over windows."""

from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Self

import numpy as np
import scipy.fft
from numpy.typing import DTypeLike, NDArray

from sim.errors import SceneError
from sim.scene import Body

# Compliance of a bonded elastic layer, per wave: displacement of its top under a traction.

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True, slots=True)
class Compliance:
    """Displacement over traction of the top, for waves of wave number k [m/Pa]; same shape as k.

    A traction (along, across, normal) exp(i k x) with x along the wave gives the displacement

        along  = from_along * along + i coupling * normal
        across = from_across * across
        normal = from_normal * normal - i coupling * along
    """

    from_along: Array
    from_across: Array
    from_normal: Array
    coupling: Array


def compliance(
    wave_number: Array, *, thickness: float, shear_modulus: float, poisson: float
) -> Compliance:
    """Return the compliance at wave numbers k >= 0 [rad/m] of a layer [m, Pa] on a rigid base.

    The plane-strain field of a wave is (a + b z) exp(k z) + (c + d z) exp(-k z). Clamped below and
    loaded on top, the layer has the closed forms here, with q = k h, kappa = 3 - 4 nu and all terms
    divided by exp(2 q), so that no wave number overflows. `from_normal` is the textbook form
    (2 kappa sinh 2q - 4q) / (2 kappa cosh 2q + 1 + kappa^2 + 4 q^2) * (1 - nu) / (G k). At k = 0:
    simple shear h / G, confined compression h / (K + 4 G / 3).
    """
    uniform = wave_number == 0
    k = np.where(uniform, 1.0, wave_number)
    kappa = 3 - 4 * poisson
    q = k * thickness
    decay = np.exp(-2 * q)
    below = kappa * (1 + decay**2) + (1 + kappa**2 + 4 * q**2) * decay
    sinh = kappa * (1 - decay**2)
    bend = (1 - poisson) / (shear_modulus * k * below)
    confined = 2 * shear_modulus * (1 - poisson) / (1 - 2 * poisson)
    couple = 4 * q**2 * decay - (1 - 2 * poisson) * kappa * (1 - decay) ** 2
    return Compliance(
        from_along=np.where(uniform, thickness / shear_modulus, bend * (sinh + 4 * q * decay)),
        from_across=np.where(uniform, thickness / shear_modulus, np.tanh(q) / (shear_modulus * k)),
        from_normal=np.where(uniform, thickness / confined, bend * (sinh - 4 * q * decay)),
        coupling=np.where(uniform, 0.0, couple / (2 * shear_modulus * k * below)),
    )


# Sampling of the layer: pixels across the body, and the period of its waves.

# Thicknesses added to twice the body's size before its waves repeat. Compared with waves that never
# repeat, forces differ by at most 0.005 % on the default body and 0.06 % on one as thick as wide
# (contacts up to two thirds of the body's width, nu up to 0.5).
MARGIN = 5.0
# Thickest body over its narrower side: the model has no sides, and the period grows with it.
THICKNESS_MAX = 2.0
# Fewest and most pixels along the longer side.
FEWEST, MOST = 16, 512


@dataclass(frozen=True)
class PixelGrid:
    """Pixels across the top of a body: (nx, ny) of about equal width.

    Tractions and displacements are sampled at the pixels' centres and contain every wave that the
    pixels can represent and none beyond (a pixel is a sinc). Compared with averaging over pixels on
    one side or both, this is the choice whose force has no bias.
    """

    body: Body
    count: int
    """Number of pixels along the longer side."""

    def __post_init__(self) -> None:
        limit = THICKNESS_MAX * min(self.body.size_x, self.body.size_y)
        if self.body.thickness > limit:
            raise SceneError(
                f"body.thickness: {self.body.thickness!r} m; allowed with tier 'layer': up to "
                f"{limit:g} m, {THICKNESS_MAX:g} times the narrower side (it knows no sides; 'fem' "
                "does)"
            )
        if not FEWEST <= self.count <= MOST:
            raise SceneError(f"grid: {self.count!r}; allowed: {FEWEST} to {MOST}")

    @cached_property
    def shape(self) -> tuple[int, int]:
        """Number of pixels along x and along y."""
        longer = max(self.body.size_x, self.body.size_y)
        x, y = (
            max(1, round(self.count * size / longer))
            for size in (self.body.size_x, self.body.size_y)
        )
        return x, y

    @cached_property
    def pixel(self) -> tuple[float, float]:
        """Width of a pixel along x and along y [m]."""
        return self.body.size_x / self.shape[0], self.body.size_y / self.shape[1]

    @property
    def area(self) -> float:
        """Area of a pixel [m^2]."""
        return self.pixel[0] * self.pixel[1]

    @cached_property
    def x(self) -> Array:
        """Centres of the pixels along x (nx,) [m]."""
        return (np.arange(self.shape[0]) + 0.5) * self.pixel[0] - self.body.size_x / 2

    @cached_property
    def y(self) -> Array:
        """Centres of the pixels along y (ny,) [m]."""
        return (np.arange(self.shape[1]) + 0.5) * self.pixel[1] - self.body.size_y / 2

    @cached_property
    def period(self) -> tuple[int, int]:
        """Number of pixels after which the waves repeat, along x and along y; even."""
        sizes = (self.body.size_x, self.body.size_y)
        x, y = (
            2
            * scipy.fft.next_fast_len(
                int(np.ceil((2 * size + MARGIN * self.body.thickness) / pixel / 2)), real=True
            )
            for size, pixel in zip(sizes, self.pixel, strict=True)
        )
        return x, y

    @cached_property
    def symbol(self) -> Array:
        """Compliance of the layer for every wave of the period (6, px, py // 2 + 1) [m/Pa].

        Rows: xx, yy, zz, xy, and xz, yz divided by i. zx = -xz and zy = -yz (both over i); the rest
        is symmetric.
        """
        kx = 2 * np.pi * np.fft.fftfreq(self.period[0], self.pixel[0])[:, None]
        ky = 2 * np.pi * np.fft.rfftfreq(self.period[1], self.pixel[1])[None, :]
        length = np.hypot(kx, ky)
        layer = self._compliance(length)
        unit = np.where(length == 0, 1.0, length)
        cosine, sine = np.where(length == 0, 1.0, kx / unit), ky / unit
        mixed = (layer.from_along - layer.from_across) * cosine * sine
        symbol = np.stack(
            [
                layer.from_along * cosine**2 + layer.from_across * sine**2,
                layer.from_along * sine**2 + layer.from_across * cosine**2,
                layer.from_normal,
                mixed,
                layer.coupling * cosine,
                layer.coupling * sine,
            ]
        )
        # Samples cannot represent the odd part of the shortest wave (irfft drops it along y).
        symbol[3:, self.period[0] // 2, :] = 0
        return symbol

    def _compliance(self, length: Array) -> Compliance:
        # With a square period each wave number occurs eight times.
        numbers, index = np.unique(length, return_inverse=True)
        layer = compliance(
            numbers,
            thickness=self.body.thickness,
            shear_modulus=self.body.shear_modulus,
            poisson=self.body.poisson,
        )
        index = index.reshape(length.shape)
        return Compliance(*(getattr(layer, name)[index] for name in Compliance.__slots__))


Spectrum = NDArray[np.complexfloating[Any, Any]]

# Most window shapes that are cached before the cache is cleared; each takes about a megabyte.
SHAPES_KEPT = 64


class Convolution:
    """Displacement of pixels by tractions on them [m], [Pa]; fields are (3, X, Y)."""

    def __init__(
        self,
        spectrum: Array,
        shape: tuple[int, int],
        padded: tuple[int, int],
        dtype: DTypeLike = np.float64,
    ) -> None:
        """Take the compliance per wave, laid out as `Grid.symbol`, for waves over `padded` pixels.

        `shape` is that of the field; beyond it, up to `padded`, there is no traction.
        """
        self._shape, self._padded = shape, padded
        parts = spectrum.astype(dtype)
        self._xx, self._yy, self._zz, self._xy = parts[:4]
        self._xz, self._yz = 1j * parts[4:]
        self.own: tuple[Array | float, Array | float] = 0.0, 0.0
        """Displacement of pixels by their own traction alone, beyond the spectrum's [m/Pa]: (X, Y)
        in the plane, and normal to it."""

    def normal(self, traction: Array) -> Array:
        """Return the normal displacement (X, Y) by a normal traction (X, Y)."""
        return self._back(self._zz * self._forward(traction)) + self.own[1] * traction

    def shear(self, traction: Array) -> Array:
        """Return the in-plane displacement (2, X, Y) by an in-plane traction (2, X, Y)."""
        x, y = self._forward(traction)
        moved = self._back(np.stack([self._xx * x + self._xy * y, self._xy * x + self._yy * y]))
        return moved + self.own[0] * traction

    def shear_by_normal(self, traction: Array) -> Array:
        """Return the in-plane displacement (2, X, Y) by a normal traction (X, Y)."""
        z = self._forward(traction)
        return self._back(np.stack([self._xz * z, self._yz * z]))

    def normal_by_shear(self, traction: Array) -> Array:
        """Return the normal displacement (X, Y) by an in-plane traction (2, X, Y)."""
        x, y = self._forward(traction)
        return self._back(-self._xz * x - self._yz * y)

    def full(self, traction: Array) -> Array:
        """Return the displacement (3, X, Y) by a traction (3, X, Y)."""
        if not traction[:2].any():
            z = self._forward(traction[2])
            moved = self._back(np.stack([self._xz * z, self._yz * z, self._zz * z]))
        else:
            x, y, z = self._forward(traction)
            moved = self._back(
                np.stack(
                    [
                        self._xx * x + self._xy * y + self._xz * z,
                        self._xy * x + self._yy * y + self._yz * z,
                        self._zz * z - self._xz * x - self._yz * y,
                    ]
                )
            )
        moved[:2] += self.own[0] * traction[:2]
        moved[2] += self.own[1] * traction[2]
        return moved

    def _forward(self, field: Array) -> Spectrum:
        # One axis at a time, so that rows of padding only are not transformed.
        half = scipy.fft.rfft(field, n=self._padded[1], axis=-1)
        return np.asarray(scipy.fft.fft(half, n=self._padded[0], axis=-2, overwrite_x=True))

    def _back(self, spectrum: Spectrum) -> Array:
        half = scipy.fft.ifft(spectrum, axis=-2, overwrite_x=True)[..., : self._shape[0], :]
        return np.asarray(scipy.fft.irfft(half, n=self._padded[1], axis=-1)[..., : self._shape[1]])


@dataclass(frozen=True, slots=True)
class Elastic:
    """Layer under a window, as the contact solvers use it."""

    answer: Convolution
    local_normal: float
    """Normal displacement of a pixel by a normal traction on it alone [m/Pa]."""
    local_shear: float
    """In-plane displacement of a pixel by an in-plane traction on it alone [m/Pa]."""

    def yielding(self, extra: Array) -> Self:
        """Return the layer whose pixels yield more by their own traction (X, Y), as a multiple."""
        if not extra.any():
            return self
        answer = copy(self.answer)
        answer.own = extra * self.local_shear, extra * self.local_normal
        return replace(self, answer=answer)


class Convolutions:
    """Convolution of the whole top, and smaller ones for windows that contain the contact."""

    def __init__(self, grid: PixelGrid, dtype: DTypeLike = np.float64) -> None:
        """Transform the grid's symbol to the response to one loaded pixel.

        Convolutions of windows have `dtype`.
        """
        self.dtype = np.dtype(dtype)
        symbol = grid.symbol
        waves = np.concatenate([symbol[:4], 1j * symbol[4:]])
        self.kernel: Array = scipy.fft.irfft2(waves, s=grid.period)
        """Displacement of the pixels (6, px, py) by a traction on the first one [m/Pa], rows as in
        `Grid.symbol`."""
        self._shape = grid.shape
        self._made: dict[tuple[int, ...], Elastic] = {}

    @cached_property
    def whole(self) -> Convolution:
        """Over all pixels, in single precision: for output, not for the solution."""
        return self._cut(self._shape, np.float32)

    def within(self, shape: tuple[int, ...]) -> Elastic:
        """Return the layer within a window of `shape`, cached by shape."""
        elastic = self._made.get(shape)
        if elastic is None:
            if len(self._made) == SHAPES_KEPT:
                self._made.clear()
            local = self.kernel[:3, 0, 0]
            elastic = self._made[shape] = Elastic(
                self._cut(shape, self.dtype), float(local[2]), float(min(local[0], local[1]))
            )
        return elastic

    def _cut(self, shape: tuple[int, ...], dtype: DTypeLike) -> Convolution:
        """Return the convolution over a window of `shape`, without the period's images.

        Padded to twice the window, it uses the kernel at true distances only, so the margin around
        the body costs nothing here.
        """
        padded = [scipy.fft.next_fast_len(2 * size - 1, real=True) for size in shape]
        reach = [np.r_[0:size, 1 - size : 0] for size in shape]
        slots = [index % size for index, size in zip(reach, padded, strict=True)]
        kernel = np.zeros((6, *padded))
        kernel[(slice(None), *np.ix_(*slots))] = self.kernel[(slice(None), *np.ix_(*reach))]
        spectrum = scipy.fft.rfft2(kernel)
        parts = np.concatenate([spectrum[:4].real, spectrum[4:].imag])
        return Convolution(parts, (shape[0], shape[1]), (padded[0], padded[1]), dtype)


@lru_cache(maxsize=2)
def convolutions(grid: PixelGrid, dtype: np.dtype[Any]) -> Convolutions:
    """Return the convolutions of a grid, cached for consecutive presses on it."""
    return Convolutions(grid, dtype)
