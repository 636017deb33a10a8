"""Elastic half-space: forces of rigid indenters without friction, displacements by point forces.

E* = E / (1 - nu^2). Strain must be small: the contact radius small compared with the indenter's
radius, and (for a layer) with the thickness. Point forces act at the origin of the surface z = 0,
where the solution is singular; z points out of the material, which fills z < 0.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def reduced_modulus(modulus: float, poisson: float) -> float:
    """Return E* = E / (1 - nu^2) [Pa], the modulus of frictionless contact with a rigid body."""
    return modulus / (1 - poisson**2)


def hertz(depth: float, radius: float, modulus: float, poisson: float) -> float:
    """Return the force of a sphere, as a paraboloid [N]: F = 4/3 E* sqrt(R) d^1.5, or 0.

    Johnson, Contact Mechanics (1985), eqs. 4.22 to 4.24; 0 without contact. Valid for contact
    radius << R; the force of a true sphere differs by 1 % at d = 0.1 R.
    """
    stiffness = 4 / 3 * reduced_modulus(modulus, poisson) * math.sqrt(radius)
    return stiffness * math.pow(max(depth, 0.0), 1.5)


def hertz_contact_radius(depth: float, radius: float) -> float:
    """Return the contact radius of a paraboloid [m]: a = sqrt(R d). Johnson (1985), eq. 4.23."""
    return math.sqrt(radius * max(depth, 0.0))


def flat_punch(depth: float, radius: float, modulus: float, poisson: float) -> float:
    """Return the force of a flat circular punch [N]: F = 2 a E* d; 0 without contact.

    Sneddon (1965); Johnson (1985), section 3.4.
    """
    return 2 * radius * reduced_modulus(modulus, poisson) * max(depth, 0.0)


def cone(depth: float, half_angle: float, modulus: float, poisson: float) -> float:
    """Return the force of a cone, `half_angle` [rad] from axis to side: F = 2/pi E* tan(angle) d^2.

    Sneddon (1965), in [N]. Linear theory, for blunt cones near pi/2; 0 without contact.
    """
    factor = 2 / math.pi * reduced_modulus(modulus, poisson)
    return factor * math.tan(half_angle) * max(depth, 0.0) ** 2


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
