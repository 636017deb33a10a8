"""Cattaneo and Mindlin's formulas against Cerruti's, each other and energy."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad

from benchmarks.independent.formulas import (
    cerruti,
    mindlin_displacement,
    mindlin_force,
    mindlin_loss,
    mindlin_return,
    mindlin_stick_radius,
    mindlin_traction,
)

NORMAL, COEFFICIENT, RADIUS = 0.5, 0.6, 1.4e-3
MOST = NORMAL * COEFFICIENT
SYSTEM = (NORMAL, COEFFICIENT, RADIUS, 0.145e6, 0.45)


def _shift_at(x: float, y: float, tangential: float) -> np.ndarray:
    """Return the surface displacement (3,) at (x, y) under the traction, by Cerruti's point load.

    Polar coordinates about the point; each chord is split where the traction has a kink.
    """
    core = mindlin_stick_radius(tangential, *SYSTEM[:3])
    place, weight = np.polynomial.legendre.leggauss(24)
    total = np.zeros(3)
    count = 96
    for direction in (np.arange(count) + 0.5) * 2 * np.pi / count:
        ahead = np.array([math.cos(direction), math.sin(direction)])
        along, square = x * ahead[0] + y * ahead[1], x * x + y * y
        ends = [0.0]
        for radius in (core, RADIUS):
            inside = along**2 - square + radius**2
            if inside > 0:
                ends += [
                    root
                    for root in (-along - math.sqrt(inside), -along + math.sqrt(inside))
                    if root > 0
                ]
        ends.sort()
        for low, high in pairwise(ends):
            # A double sine removes the square-root singularities of the traction at both ends.
            angle = np.pi / 2 * place
            distance = (high + low) / 2 + (high - low) / 2 * np.sin(angle)
            step = (high - low) / 2 * np.cos(angle) * np.pi / 2 * weight
            at_x, at_y = distance * ahead[0], distance * ahead[1]
            traction = mindlin_traction(np.hypot(x + at_x, y + at_y), tangential, *SYSTEM[:3])
            total += (traction * distance * step) @ cerruti(-at_x, -at_y, 1.0, *SYSTEM[3:])
    return total * 2 * np.pi / count


@pytest.mark.parametrize("fraction", [0.2, 0.7, 0.95])
def test_the_sticking_core_moves_as_one_and_by_the_formula(fraction: float) -> None:
    tangential = fraction * MOST
    shift = mindlin_displacement(tangential, *SYSTEM)
    core = mindlin_stick_radius(tangential, *SYSTEM[:3])
    for x, y in ((0.0, 0.0), (0.6 * core, 0.0), (-0.3 * core, 0.8 * core)):
        moved = _shift_at(x, y, tangential)
        assert moved[0] == pytest.approx(shift, rel=1e-5)
        assert abs(moved[1]) < 1e-5 * shift


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (0.7, 0.0), (0.0, 0.7), (0.5, -0.6)])
def test_full_slip_shears_the_surface_as_hertz_traction_does(x: float, y: float) -> None:
    """Under q = q0 sqrt(a^2 - r^2)/a: u_x = pi q0 / (32 G a) (4 (2 - nu) a^2 - (4 - 3 nu) x^2
    - (4 - nu) y^2), u_y = pi q0 / (32 G a) 2 nu x y. Johnson, Contact Mechanics (1985), 3.91.
    """
    modulus, poisson = SYSTEM[3:]
    x, y = x * RADIUS, y * RADIUS
    peak = 3 * MOST / (2 * math.pi * RADIUS**2)
    scale = math.pi * peak / (32 * modulus / (2 * (1 + poisson)) * RADIUS)
    bracket = 4 * (2 - poisson) * RADIUS**2 - (4 - 3 * poisson) * x**2 - (4 - poisson) * y**2
    moved = _shift_at(x, y, MOST)
    assert moved[0] == pytest.approx(scale * bracket, rel=1e-6)
    assert moved[1] == pytest.approx(scale * 2 * poisson * x * y, rel=1e-6, abs=1e-15)


def test_slipping_points_stay_behind() -> None:
    tangential = 0.7 * MOST
    edge = _shift_at(0.98 * RADIUS, 0.0, tangential)[0]
    assert 0 < edge < 0.99 * mindlin_displacement(tangential, *SYSTEM)


@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.8, 1.0])
def test_traction_adds_up_to_the_force_and_never_beats_friction(fraction: float) -> None:
    tangential = fraction * MOST
    core = mindlin_stick_radius(tangential, *SYSTEM[:3])

    def ring(r: float) -> float:
        return 2 * math.pi * r * float(mindlin_traction(r, tangential, *SYSTEM[:3]))

    total = sum(quad(ring, low, high, epsabs=1e-12)[0] for low, high in ((0, core), (core, RADIUS)))
    assert total == pytest.approx(tangential, rel=1e-6, abs=1e-12)
    r = np.linspace(0, RADIUS, 50)
    pressure = 3 * NORMAL / (2 * math.pi * RADIUS**3) * np.sqrt(RADIUS**2 - r**2)
    traction = mindlin_traction(r, tangential, *SYSTEM[:3])
    assert np.all(traction <= COEFFICIENT * pressure * (1 + 1e-12))
    slipping = r > core
    np.testing.assert_allclose(traction[slipping], COEFFICIENT * pressure[slipping])


def test_a_small_push_meets_the_stiffness_of_full_stick() -> None:
    modulus, poisson = SYSTEM[3:]
    stiffness = 8 * RADIUS * modulus / (2 * (1 + poisson)) / (2 - poisson)
    assert mindlin_displacement(1e-6 * MOST, *SYSTEM) == pytest.approx(
        1e-6 * MOST / stiffness, rel=1e-6
    )


def test_force_is_the_inverse_of_displacement_up_to_full_slip() -> None:
    for fraction in (-1.0, -0.4, 0.0, 0.1, 0.5, 0.99, 1.0):
        shift = mindlin_displacement(fraction * MOST, *SYSTEM)
        assert mindlin_force(shift, *SYSTEM) == pytest.approx(fraction * MOST, rel=1e-9, abs=1e-15)
    assert mindlin_force(10 * mindlin_displacement(MOST, *SYSTEM), *SYSTEM) == MOST


def test_return_starts_at_the_turn_and_closes_the_loop() -> None:
    turn = 0.8 * MOST
    out = mindlin_displacement(turn, *SYSTEM)
    assert mindlin_return(turn, turn, *SYSTEM) == pytest.approx(out)
    assert mindlin_return(-turn, turn, *SYSTEM) == pytest.approx(-out)
    assert 0 < mindlin_return(0.0, turn, *SYSTEM) < out


def test_return_follows_from_adding_a_reversed_slip_ring() -> None:
    """Mindlin & Deresiewicz: on unloading, slip starts again inwards, at twice the traction.

    First loading by T*, plus a push back by T* - T in a contact with doubled friction.
    """
    turn, tangential = 0.8 * MOST, 0.1 * MOST
    doubled = (NORMAL, 2 * COEFFICIENT, *SYSTEM[2:])
    expected = mindlin_displacement(turn, *SYSTEM) - mindlin_displacement(
        turn - tangential, *doubled
    )
    assert mindlin_return(tangential, turn, *SYSTEM) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("fraction", [0.1, 0.6, 1.0])
def test_loss_is_the_area_of_the_loop(fraction: float) -> None:
    turn = fraction * MOST
    # Shift on unloading minus shift on loading, integrated over the force.
    area, _ = quad(
        lambda force: mindlin_return(force, turn, *SYSTEM) + mindlin_return(-force, turn, *SYSTEM),
        -turn,
        turn,
        epsabs=1e-14,
    )
    assert mindlin_loss(turn, *SYSTEM) == pytest.approx(area, rel=1e-6)


def test_more_than_friction_can_hold_is_refused() -> None:
    with pytest.raises(ValueError, match="mu N"):
        mindlin_displacement(1.01 * MOST, *SYSTEM)
    with pytest.raises(ValueError, match="mu N"):
        mindlin_stick_radius(math.nan, *SYSTEM[:3])
    with pytest.raises(ValueError, match="allowed"):
        mindlin_return(0.5 * MOST, 0.4 * MOST, *SYSTEM)
