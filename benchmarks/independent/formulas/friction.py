"""Cattaneo and Mindlin: a sphere on a half-space, pressed by N, then pushed sideways by T <= mu N.

The contact (Hertz radius a) sticks within r < c and slips outside; the sphere is rigid and N is
constant. Two small effects are neglected: N drags the surface inwards (except at nu = 0.5), and
points slip a little across T (except at nu = 0). Formulas: Cattaneo (1938), Mindlin (1949);
Johnson, Contact Mechanics (1985), sections 7.2 (push) and 7.4 (back and forth).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def mindlin_stick_radius(
    tangential: float, normal: float, coefficient: float, contact_radius: float
) -> float:
    """Return the radius of the sticking core [m]: c = a (1 - T/(mu N))^(1/3).

    Raises:
        ValueError: |T| above mu N.
    """
    held = 1 - abs(_share(tangential, normal, coefficient))
    return contact_radius * float(np.cbrt(held))


def mindlin_traction(
    r: ArrayLike, tangential: float, normal: float, coefficient: float, contact_radius: float
) -> Array:
    """Return the shear traction along T at distance `r` from the axis, on first loading [Pa].

    q = 3 mu N / (2 pi a^3) (sqrt(a^2 - r^2) - sqrt(c^2 - r^2)), each root 0 where not
    real.
    """
    r = np.asarray(r, float)
    core = mindlin_stick_radius(tangential, normal, coefficient, contact_radius)
    slip, stick = (np.sqrt(np.maximum(radius**2 - r**2, 0)) for radius in (contact_radius, core))
    scale = 3 * coefficient * normal / (2 * math.pi * contact_radius**3)
    traction: Array = math.copysign(scale, tangential) * (slip - stick)
    return traction


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
    shift = _full_shift(normal, coefficient, contact_radius, modulus, poisson)
    return math.copysign(shift * (1 - float(np.cbrt(1 - abs(fraction)) ** 2)), fraction)


def mindlin_force(
    displacement: float,
    normal: float,
    coefficient: float,
    contact_radius: float,
    modulus: float,
    poisson: float,
) -> float:
    """Return the tangential force at a sideways shift, on first loading [N]; mu N in full slip."""
    shift = _full_shift(normal, coefficient, contact_radius, modulus, poisson)
    part = max(0.0, 1 - abs(displacement) / shift)
    return math.copysign(coefficient * normal * (1 - part**1.5), displacement)


def mindlin_return(
    tangential: float,
    turned_at: float,
    normal: float,
    coefficient: float,
    contact_radius: float,
    modulus: float,
    poisson: float,
) -> float:
    """Return the shift during unloading from `turned_at`, for T between +-`turned_at` [m].

    Masing's rule applied to first loading D: D(T*) - 2 D((T* - T)/2), which is Mindlin &
    Deresiewicz, J. Appl. Mech. 20 (1953) 327. Reloading from -T* is the mirror image,
    -mindlin_return(-T, T*).

    Raises:
        ValueError: |T| above |T*|, or |T*| above mu N.
    """
    if abs(tangential) > abs(turned_at):
        raise ValueError(
            f"tangential: {tangential!r} N; allowed: -{abs(turned_at):g} to {abs(turned_at):g} N"
        )
    system = (normal, coefficient, contact_radius, modulus, poisson)
    turn = mindlin_displacement(turned_at, *system)
    return turn - 2 * mindlin_displacement((turned_at - tangential) / 2, *system)


def mindlin_loss(
    amplitude: float,
    normal: float,
    coefficient: float,
    contact_radius: float,
    modulus: float,
    poisson: float,
) -> float:
    """Return the energy dissipated in one cycle of T between +-`amplitude` [J].

    9 (mu N)^2 (2 - nu) / (10 a G) (1 - q^(5/3) - 5/6 s (1 + q^(2/3))), s = T*/(mu N), q = 1 - s:
    Mindlin & Deresiewicz (1953).

    Raises:
        ValueError: |T*| above mu N.
    """
    fraction = abs(_share(amplitude, normal, coefficient))
    held = float(np.cbrt(1 - fraction))
    shift = _full_shift(normal, coefficient, contact_radius, modulus, poisson)
    bracket = 1 - held**5 - 5 / 6 * fraction * (1 + held**2)
    return 24 / 5 * coefficient * normal * shift * bracket


def _full_shift(
    normal: float, coefficient: float, contact_radius: float, modulus: float, poisson: float
) -> float:
    """Shift at which the last point slips [m]."""
    shear_modulus = modulus / (2 * (1 + poisson))
    return 3 * coefficient * normal * (2 - poisson) / (16 * contact_radius * shear_modulus)


def _share(tangential: float, normal: float, coefficient: float) -> float:
    most = coefficient * normal
    if not abs(tangential) <= most:
        raise ValueError(f"tangential: {tangential!r} N; allowed: -{most:g} to {most:g} N (mu N)")
    return tangential / most
