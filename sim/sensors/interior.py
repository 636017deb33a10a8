"""What happens inside a bonded layer, from what its top does."""

from __future__ import annotations

import math

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from sim.body import Body
from sim.checks import check_range
from sim.sensors.field import SurfaceField, cubic_weights

Array = NDArray[np.float64]
Waves = NDArray[np.complex128]

STEP = 0.5e-3
"""Distance of samples of the top [m]. A wave that this cannot hold has died away to a hundredth
0.75 mm below the top."""
MARGIN = 2.0
"""Thicknesses beside the body before its waves repeat; in the first of them the displacement of the
edge fades to nothing."""


class Interior:
    """Displacement and its gradient at places inside a layer, linear in that of the top.

    The layer is linear elastic, bonded to a rigid base and without sides, and its top is displaced
    as given: each wave of the top's displacement reaches down along the closed form of `_reach`.
    Small strains are assumed below the top only; the displacement of the top may come from a
    large-strain solver.

    Args:
        body: A flat layer.
        depth: Of the places below the untouched top [m], up to the thickness.
        places: Their (x, y), (n, 2) [m].

    Raises:
        SceneError: A depth outside of the layer.
    """

    def __init__(self, body: Body, depth: float, places: Array) -> None:
        check_range("interior", "depth", depth, 0.0, body.thickness, unit="m")
        self._samples = []
        spacing = []
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
        # The half of the waves that a real transform leaves out mirrors the half that it has.
        weight = np.full(len(self._ky), 2.0)
        weight[0] = 1.0
        if count_y % 2 == 0:
            weight[-1] = 1.0
        start_x, start_y = (samples[0] for samples in self._samples)
        self._at_x = np.exp(1j * self._kx * (places[:, :1] - start_x)) / count_x
        self._at_y = np.exp(1j * self._ky * (places[:, 1:] - start_y)) * weight / count_y

    def at(self, top: SurfaceField) -> tuple[Array, Array]:
        """Displacement (F, n, 3) [m] and gradient (F, n, 3, 3), du_i / dx_j, at the places."""
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
        """Amplitudes (F, 3, kx, ky) of the top's displacement."""
        across_x, across_y = (
            cubic_weights(axis, samples) * fade[:, None]
            for axis, samples, fade in zip((top.x, top.y), self._samples, self._fade, strict=True)
        )
        planes = np.moveaxis(top.displacement, 3, 1).astype(float)
        waves: Waves = scipy.fft.rfft2(across_x @ planes @ across_y.T)
        return waves

    def _summed(self, waves: Waves, at_x: Waves, at_y: Waves) -> Array:
        """Values (F, n, 3) of waves (F, 3, kx, ky) at the places."""
        lines = np.einsum("nk,fckl->fncl", at_x, waves, optimize=True)
        values: Array = np.einsum("fncl,nl->fnc", lines, at_y).real
        return values


def _fade(samples: Array, half: float, width: float) -> Array:
    """1 on the body, down to 0 within `width` beside it, smoothly (K,)."""
    beside = np.clip((np.abs(samples) - half) / width, 0.0, 1.0)
    fade: Array = 0.5 + 0.5 * np.cos(np.pi * beside)
    return fade


def _reach(
    kx: Array, ky: Array, *, height: float, thickness: float, poisson: float
) -> tuple[Waves, Waves]:
    """What a wave of the top's displacement is at `height` above the base, and its slope along z.

    Both (3, 3, kx, ky). In a plane-strain wave along x, u_x = i U(s) exp(ikx), u_z = W(s) exp(ikx)
    with s the height above the base, Navier's equations and u = 0 at s = 0 leave two numbers S, D:

        k U = S (kappa sinh q + q cosh q) + D q sinh q
        k W = S q sinh q + D (q cosh q - kappa sinh q),    q = k s, kappa = 3 - 4 nu,

    which the displacement of the top fixes. The part across the wave goes as sinh q. Both go
    linearly where k = 0. The same solution from the top's traction: `sim.layer.compliance`.
    """
    length = np.hypot(kx, ky)
    still = length == 0
    k = np.where(still, 1.0 / thickness, length)
    kappa = 3 - 4 * poisson
    here, here_slope = _plane_waves(k * height, kappa)
    top, _ = _plane_waves(k * thickness, kappa)
    whole = top[0, 0] * top[1, 1] - top[0, 1] * top[1, 0]
    back = np.array([[top[1, 1], -top[0, 1]], [-top[1, 0], top[0, 0]]]) / whole
    # exp(q) is left out of every entry, so that no wave number overflows; here it comes back.
    decay = np.exp(k * (height - thickness))
    plane = np.einsum("abkl,bckl->ackl", here, back) * decay
    plane_slope = np.einsum("abkl,bckl->ackl", here_slope, back) * decay * k
    scale = decay / -np.expm1(-2 * k * thickness)
    across = -np.expm1(-2 * k * height) * scale
    across_slope = (1 + np.exp(-2 * k * height)) * scale * k

    # Without a wave the layer is sheared and squeezed evenly: everything goes linearly.
    for values, slopes, share in (
        (plane[0, 0], plane_slope[0, 0], 1.0),
        (plane[1, 1], plane_slope[1, 1], 1.0),
        (plane[0, 1], plane_slope[0, 1], 0.0),
        (plane[1, 0], plane_slope[1, 0], 0.0),
        (across, across_slope, 1.0),
    ):
        values[still] = share * height / thickness
        slopes[still] = share / thickness
    cosine, sine = np.where(still, 1.0, kx / k), np.where(still, 0.0, ky / k)
    return (
        _turned(plane, across, cosine, sine),
        _turned(plane_slope, across_slope, cosine, sine),
    )


def _plane_waves(q: Array, kappa: float) -> tuple[Array, Array]:
    """Rows k U, k W, columns S, D (2, 2, ...), and their slopes in q; both over exp(q)."""
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
    """The matrix (3, 3, ...) in x, y, z of a wave that runs along (cosine, sine).

    With u_along = i U the two off-diagonal entries of the plane part become imaginary.
    """
    (along, from_normal), (to_normal, normal) = plane
    mixed = (along - across) * cosine * sine
    return np.array(
        [
            [
                along * cosine**2 + across * sine**2 + 0j,
                mixed + 0j,
                1j * from_normal * cosine,
            ],
            [mixed + 0j, along * sine**2 + across * cosine**2 + 0j, 1j * from_normal * sine],
            [-1j * to_normal * cosine, -1j * to_normal * sine, normal + 0j],
        ]
    )
