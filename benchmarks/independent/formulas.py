"""Closed forms of presses, which share no code with the simulator.

SI units; a force that presses and a depth are positive. Displacements are in the contact frame: z
points out of the material. E is Young's modulus, nu Poisson's ratio; E*, M, G and K are those of
the first functions.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def reduced_modulus(modulus: float, poisson: float) -> float:
    """Return E* = E / (1 - nu^2) [Pa], the modulus of frictionless contact with a rigid body."""
    return modulus / (1 - poisson**2)


def oedometric_modulus(modulus: float, poisson: float) -> float:
    """Return M = E (1 - nu) / ((1 + nu)(1 - 2 nu)) [Pa]: confined stress over strain."""
    return modulus * (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson))


def shear_and_bulk(modulus: float, poisson: float) -> tuple[float, float]:
    """Return G = E / (2 (1 + nu)) and K = E / (3 (1 - 2 nu)) [Pa]."""
    return modulus / (2 * (1 + poisson)), modulus / (3 * (1 - 2 * poisson))


# Elastic half-space. Strain must be small: the contact radius small compared with the indenter's
# radius, and (for a layer) with the thickness.


def hertz(depth: float, radius: float, modulus: float, poisson: float) -> float:
    """Return the force of a sphere, as a paraboloid [N]: F = 4/3 E* sqrt(R) d^1.5, or 0.

    Johnson, Contact Mechanics (1985), eqs. 4.22 to 4.24; 0 without contact. Valid for contact
    radius << R; the force of a true sphere differs by 1 % at d = 0.1 R.
    """
    stiffness = 4 / 3 * reduced_modulus(modulus, poisson) * math.sqrt(radius)
    return stiffness * math.pow(max(depth, 0.0), 1.5)


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


# Weight of a linear body: a wide bonded layer, from z = -h to 0, is a function of height at several
# heights from its sides.


def layer_sag(
    z: ArrayLike,
    acceleration: Sequence[float],
    thickness: float,
    density: float,
    modulus: float,
    poisson: float,
) -> Array:
    """Return the displacement (..., 3) at height `z` under a uniform acceleration (x, y, z) [m].

    u_i = density a_i (h^2 - z^2) / (2 C_i), C = (G, G, M): the solution of C u'' + density a = 0,
    u(-h) = 0, u'(0) = 0. The top sinks by density g h^2 / (2 M).
    """
    shear, _ = shear_and_bulk(modulus, poisson)
    stiffness = np.array([shear, shear, oedometric_modulus(modulus, poisson)])
    profile = (thickness**2 - np.square(np.asarray(z, float))) / 2
    return np.asarray(profile[..., None] * density * np.asarray(acceleration, float) / stiffness)
