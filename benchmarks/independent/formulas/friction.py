"""Cattaneo and Mindlin: a sphere on a half-space, pressed by N, then pushed sideways by T <= mu N.

The contact (Hertz radius a) sticks within r < c and slips outside; the sphere is rigid and N is
constant. Two small effects are neglected: N drags the surface inwards (except at nu = 0.5), and
points slip a little across T (except at nu = 0). Formulas: Cattaneo (1938), Mindlin (1949);
Johnson, Contact Mechanics (1985), section 7.2.
"""

from __future__ import annotations

import math

import numpy as np


def mindlin_stick_radius(
    tangential: float, normal: float, coefficient: float, contact_radius: float
) -> float:
    """Return the radius of the sticking core [m]: c = a (1 - T/(mu N))^(1/3).

    Raises:
        ValueError: |T| above mu N.
    """
    held = 1 - abs(_share(tangential, normal, coefficient))
    return contact_radius * float(np.cbrt(held))


def mindlin_displacement(
    tangential: float,
    normal: float,
    coefficient: float,
    contact_radius: float,
    modulus: float,
    poisson: float,
) -> float:
    """Return the sideways shift of the sphere relative to the far body, on first loading [m].

    D = 3 mu N (2 - nu) / (16 a G) (1 - (1 - T/(mu N))^(2/3)), G = E/(2 (1 + nu)).

    Raises:
        ValueError: |T| above mu N.
    """
    fraction = _share(tangential, normal, coefficient)
    shear = modulus / (2 * (1 + poisson))
    shift = 3 * coefficient * normal * (2 - poisson) / (16 * contact_radius * shear)
    return math.copysign(shift * (1 - float(np.cbrt(1 - abs(fraction)) ** 2)), fraction)


def _share(tangential: float, normal: float, coefficient: float) -> float:
    most = coefficient * normal
    if not abs(tangential) <= most:
        raise ValueError(f"tangential: {tangential!r} N; allowed: -{most:g} to {most:g} N (mu N)")
    return tangential / most
