"""Rigid indenters on an elastic half-space, frictionless: force, contact radius, surface.

E* = E / (1 - nu^2) throughout. All solutions assume small strain: the contact radius must be small
compared with the indenter's radius, and (for a layer) with the thickness.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

Array = NDArray[np.float64]


def reduced_modulus(modulus: float, poisson: float) -> float:
    """Return E* = E / (1 - nu^2) [Pa], the modulus of frictionless contact with a rigid body."""
    return modulus / (1 - poisson**2)


def hertz(depth: float, radius: float, modulus: float, poisson: float) -> float:
    """Return the force of a sphere, as a paraboloid [N]: F = 4/3 E* sqrt(R) d^1.5, or 0.

    Johnson, Contact Mechanics (1985), eqs. 4.22 to 4.24; 0 without contact. Valid for contact
    radius << R; the error relative to the true sphere (`sphere`) is 1 % at d = 0.1 R.
    """
    stiffness = 4 / 3 * reduced_modulus(modulus, poisson) * math.sqrt(radius)
    return stiffness * math.pow(max(depth, 0.0), 1.5)


def hertz_contact_radius(depth: float, radius: float) -> float:
    """Return the contact radius of a paraboloid [m]: a = sqrt(R d). Johnson (1985), eq. 4.23."""
    return math.sqrt(radius * max(depth, 0.0))


def hertz_pressure(
    r: ArrayLike, depth: float, radius: float, modulus: float, poisson: float
) -> Array:
    """Return the contact pressure at `r` from the axis [Pa]: p = 2 E*/(pi R) sqrt(a^2 - r^2).

    Johnson (1985), eqs. 3.39 and 4.22; 0 outside of the contact.
    """
    inside = np.maximum(radius * max(depth, 0.0) - np.square(np.asarray(r, float)), 0.0)
    pressure: Array = 2 * reduced_modulus(modulus, poisson) / (math.pi * radius) * np.sqrt(inside)
    return pressure


def hertz_displacement(r: ArrayLike, depth: float, radius: float) -> Array:
    """Return the height of the surface above the undeformed plane at `r` [m], always negative.

    u_z = -((2 a^2 - r^2) asin(a/r) + a sqrt(r^2 - a^2)) / (pi R) outside, -(d - r^2/(2 R)) inside:
    Johnson (1985), eqs. 3.41 and 3.42.
    """
    r = np.asarray(r, float)
    contact_radius = hertz_contact_radius(depth, radius)
    outside = np.maximum(r, contact_radius)
    angle = np.arcsin(np.divide(contact_radius, outside, out=np.ones_like(r), where=outside > 0))
    leg = np.sqrt(np.maximum(outside**2 - contact_radius**2, 0.0))
    beyond = ((2 * contact_radius**2 - r**2) * angle + contact_radius * leg) / (math.pi * radius)
    return np.where(r > contact_radius, -beyond, r**2 / (2 * radius) - depth)


def sphere(depth: float, radius: float, modulus: float, poisson: float) -> float:
    """Return the force of a true sphere [N]: F = E* ((a^2 + R^2) artanh(a/R) - a R), or 0.

    Sneddon, Int. J. Eng. Sci. 3 (1965) 47, with ln((R+a)/(R-a)) = 2 artanh(a/R); 0 without contact.
    """
    contact_radius = sphere_contact_radius(depth, radius)
    logarithm = math.atanh(contact_radius / radius)
    square = contact_radius**2 + radius**2
    return reduced_modulus(modulus, poisson) * (square * logarithm - contact_radius * radius)


def sphere_contact_radius(depth: float, radius: float) -> float:
    """Return the contact radius of a true sphere [m]: the root of d = a artanh(a/R), below R.

    Sneddon (1965). Solved for depths up to 18 R, where a is R to machine precision.
    """
    if depth <= 0:
        return 0.0
    nearly_one = 1 - 2**-53
    return radius * float(
        brentq(lambda u: u * math.atanh(u) - depth / radius, 0.0, nearly_one, xtol=1e-16)
    )


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


def cone_contact_radius(depth: float, half_angle: float) -> float:
    """Return the contact radius of a cone [m]: a = 2/pi d tan(angle). Sneddon (1965)."""
    return 2 / math.pi * max(depth, 0.0) * math.tan(half_angle)
