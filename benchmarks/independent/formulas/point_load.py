"""Displacement of a half-space's surface under a point force: Boussinesq and Cerruti.

Contact frame: z points out of the material, which fills z < 0; the force acts on the material at
the origin of the surface z = 0, where the solution is singular. Valid for small strain and any
Poisson's ratio.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def boussinesq(x: ArrayLike, y: ArrayLike, force: float, modulus: float, poisson: float) -> Array:
    """Return the displacement (..., 3) at (x, y) [m] under `force` along +z (pulling) [N].

    u_z = (1 - nu^2) F / (pi E r), u_r = (1 + nu)(1 - 2 nu) F / (2 pi E r): Johnson, Contact
    Mechanics (1985), eqs. 3.22, with both axes reversed to point out of the material.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    r = np.hypot(x, y)
    radial = (1 + poisson) * (1 - 2 * poisson) * force / (2 * math.pi * modulus * r)
    upward = (1 - poisson**2) * force / (math.pi * modulus * r)
    return np.stack(np.broadcast_arrays(radial * x / r, radial * y / r, upward), axis=-1)


def cerruti(x: ArrayLike, y: ArrayLike, force: float, modulus: float, poisson: float) -> Array:
    """Return the displacement (..., 3) at (x, y) [m] under `force` along +x [N].

    With G = E / (2 (1 + nu)): u_x = F/(2 pi G) ((1 - nu)/r + nu x^2/r^3),
    u_y = F/(2 pi G) nu x y/r^3, u_z = -F/(4 pi G) (1 - 2 nu) x/r^2: Johnson (1985), eqs. 3.75,
    with the z axis reversed to point out of the material.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    r = np.hypot(x, y)
    scale = force * (1 + poisson) / (math.pi * modulus)
    along = scale * ((1 - poisson) / r + poisson * x**2 / r**3)
    across = scale * poisson * x * y / r**3
    upward = -scale / 2 * (1 - 2 * poisson) * x / r**2
    return np.stack(np.broadcast_arrays(along, across, upward), axis=-1)
