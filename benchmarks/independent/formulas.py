"""Closed forms of linear elasticity, which share no code with the simulator.

SI units; a force that presses and a depth are positive. Displacements are in the contact frame: z
points out of the material. E is Young's modulus, nu Poisson's ratio; E*, M, G and K are those of
the first functions.
"""

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
