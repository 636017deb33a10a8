"""The field of small magnets."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MU_0_OVER_4_PI = 1e-7
"""Magnetic constant over 4 pi [T m / A], to nine digits."""


def flux_density(moments: Array, magnets: Array, places: Array) -> Array:
    """Flux density (..., h, 3) [T] of m dipoles, summed, at h places.

    B = mu0 / 4 pi (3 r (m . r) / r^5 - m / r^3), r from magnet to place (Jackson, Classical
    Electrodynamics, section 5.6).

    Args:
        moments: (..., m, 3) [A m^2].
        magnets: Where they are (..., m, 3) [m].
        places: (h, 3) [m].
    """
    apart = places[:, None, :] - magnets[..., None, :, :]
    distance = np.linalg.norm(apart, axis=-1, keepdims=True)
    moment = moments[..., None, :, :]
    along = (moment * apart).sum(axis=-1, keepdims=True)
    field: Array = (3 * apart * along / distance**5 - moment / distance**3).sum(axis=-2)
    return MU_0_OVER_4_PI * field


def rotations(gradient: Array) -> Array:
    """The rotation R (..., 3, 3) in F = R U, F = 1 + gradient: how a small rigid body turns."""
    left, _, right = np.linalg.svd(np.eye(3) + gradient)
    # A deformation that turns inside out would make a mirror image of the nearest orthogonal one.
    left[..., -1] *= np.sign(np.linalg.det(left @ right))[..., None]
    turn: Array = left @ right
    return turn
