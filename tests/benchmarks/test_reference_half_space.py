"""Half-space references against each other, quadrature and their limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss
from scipy.integrate import quad

from benchmarks.independent.formulas import (
    boussinesq,
    cerruti,
    cone,
    cone_contact_radius,
    flat_punch,
    hertz,
    hertz_contact_radius,
    hertz_displacement,
    hertz_pressure,
    sphere,
    sphere_contact_radius,
)

SOFT = (0.145e6, 0.45)


def _galin_sneddon_force(depth: float, radius: float, slope, modulus: float, poisson: float):
    """F = 2 E* int_0^a x^2 z'(x) / sqrt(a^2 - x^2) dx, the second of Sneddon's two forms."""
    value, _ = quad(
        lambda angle: slope(radius * math.sin(angle)) * (radius * math.sin(angle)) ** 2,
        0,
        np.pi / 2,
    )
    return 2 * modulus / (1 - poisson**2) * value


def _galin_sneddon_depth(radius: float, slope) -> float:
    """D = a int_0^a z'(x) / sqrt(a^2 - x^2) dx."""
    return radius * quad(lambda angle: slope(radius * math.sin(angle)), 0, np.pi / 2)[0]


@pytest.mark.parametrize("depth", [1e-5, 2e-4, 1.5e-3])
@pytest.mark.parametrize(
    ("force", "contact_radius", "argument", "slope"),
    [
        (hertz, hertz_contact_radius, 4e-3, lambda x: x / 4e-3),
        (sphere, sphere_contact_radius, 4e-3, lambda x: x / math.sqrt(4e-3**2 - x**2)),
        (cone, cone_contact_radius, 1.2, lambda x: 1 / math.tan(1.2)),
    ],
    ids=["paraboloid", "sphere", "cone"],
)
def test_force_and_contact_radius_solve_the_integral_of_the_profile(
    force, contact_radius, argument: float, slope, depth: float
) -> None:
    radius = contact_radius(depth, argument)
    assert _galin_sneddon_depth(radius, slope) == pytest.approx(depth, rel=1e-10)
    expected = _galin_sneddon_force(depth, radius, slope, *SOFT)
    assert force(depth, argument, *SOFT) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize(
    ("force", "contact_radius", "argument"),
    [
        (hertz, hertz_contact_radius, 4e-3),
        (sphere, sphere_contact_radius, 4e-3),
        (cone, cone_contact_radius, 1.3),
    ],
    ids=["paraboloid", "sphere", "cone"],
)
def test_stiffness_is_that_of_a_punch_as_wide_as_the_contact(
    force, contact_radius, argument: float
) -> None:
    depth, step = 1e-3, 1e-7
    slope = (force(depth + step, argument, *SOFT) - force(depth - step, argument, *SOFT)) / 2 / step
    punch = flat_punch(1.0, contact_radius(depth, argument), *SOFT)
    assert slope == pytest.approx(punch, rel=1e-6)


def test_a_sphere_is_a_paraboloid_while_the_press_is_shallow() -> None:
    assert sphere(1e-6, 4e-3, *SOFT) == pytest.approx(hertz(1e-6, 4e-3, *SOFT), rel=1e-3)
    assert sphere(0.4e-3, 4e-3, *SOFT) == pytest.approx(hertz(0.4e-3, 4e-3, *SOFT), rel=1.5e-2)


def test_nothing_presses_without_contact() -> None:
    for force in (hertz, sphere, flat_punch, cone):
        assert force(0.0, 1.0, *SOFT) == 0
        assert force(-1e-3, 1.0, *SOFT) == 0


def test_hertz_pressure_adds_up_to_hertz_force() -> None:
    contact_radius = hertz_contact_radius(1e-3, 4e-3)

    def ring(r: float) -> float:
        return 2 * math.pi * r * float(hertz_pressure(r, 1e-3, 4e-3, *SOFT))

    force, _ = quad(ring, 0, contact_radius, epsabs=0, epsrel=1e-10)
    assert force == pytest.approx(hertz(1e-3, 4e-3, *SOFT), rel=1e-8)
    assert hertz_pressure(1.01 * contact_radius, 1e-3, 4e-3, *SOFT) == 0


def _surface_under(traction, load, radius: float, x: float, points: int = 48):
    """Return the displacement (3,) at (x, 0) under traction(r) on a disc, by point load `load`.

    Polar coordinates about (x, 0) remove the pole; the substitution by sines removes the square
    root at the ends of each chord.
    """
    place, weight = leggauss(points)
    total = np.zeros(3)
    directions = (np.arange(points) + 0.5) * 2 * np.pi / points
    for direction in directions:
        along, across = np.cos(direction), np.sin(direction)
        reach = -x * along + math.sqrt(radius**2 - (x * across) ** 2)
        angle = np.pi / 4 * (place + 1)
        distance = reach * np.sin(angle)
        step = np.pi / 4 * weight * reach * np.cos(angle)
        at_x, at_y = distance * along, distance * across
        strength = traction(np.hypot(x + at_x, at_y)) * distance * step
        total += strength @ load(-at_x, -at_y, 1.0, *SOFT) * 2 * np.pi / points
    return total


@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.8])
def test_boussinesq_under_hertz_pressure_gives_the_paraboloid(fraction: float) -> None:
    depth, radius = 0.3e-3, 4e-3
    contact_radius = hertz_contact_radius(depth, radius)
    x = fraction * contact_radius

    def pull(r):
        return -hertz_pressure(r, depth, radius, *SOFT)

    moved = _surface_under(pull, boussinesq, contact_radius, x)
    assert moved[2] == pytest.approx(x**2 / (2 * radius) - depth, rel=1e-6)
    assert hertz_displacement(x, depth, radius) == pytest.approx(moved[2], rel=1e-6)
    # u_r = -(1 - 2 nu)(1 + nu)/(3 E) p0 a^2/r (1 - (1 - r^2/a^2)^1.5): Johnson (1985), eq. 3.41b.
    modulus, poisson = SOFT
    peak = float(hertz_pressure(0, depth, radius, *SOFT))
    drag = (1 - 2 * poisson) * (1 + poisson) / (3 * modulus) * peak * contact_radius
    inwards = -drag * (1 - (1 - fraction**2) ** 1.5) / fraction if fraction else 0.0
    assert moved[0] == pytest.approx(inwards, rel=1e-5, abs=1e-12)
    assert moved[1] == pytest.approx(0, abs=1e-12)


def test_hertz_displacement_outside_is_the_pressure_seen_from_there() -> None:
    depth, radius = 0.3e-3, 4e-3
    contact_radius = hertz_contact_radius(depth, radius)
    far = 3 * contact_radius
    place, weight = leggauss(40)
    r, ring = contact_radius / 2 * (place + 1), contact_radius / 2 * weight
    turn = (np.arange(64) + 0.5) * 2 * np.pi / 64
    x, y = np.multiply.outer(r, np.cos(turn)), np.multiply.outer(r, np.sin(turn))
    load = hertz_pressure(r, depth, radius, *SOFT) * r * ring * 2 * np.pi / 64
    height = -np.sum(load[:, None] * boussinesq(far - x, -y, 1.0, *SOFT)[..., 2])
    assert hertz_displacement(far, depth, radius) == pytest.approx(height, rel=1e-4)
    inside, outside = contact_radius * (1 - 1e-9), contact_radius * (1 + 1e-9)
    joined = hertz_displacement([inside, outside], depth, radius)
    assert joined[0] == pytest.approx(joined[1], rel=1e-6)


@pytest.mark.parametrize("fraction", [0.0, 0.5, 0.9])
def test_cerruti_under_mindlins_punch_traction_moves_the_disc_evenly(fraction: float) -> None:
    """T/(2 pi a sqrt(a^2 - r^2)) shifts the whole disc by (2 - nu) T/(8 G a): Mindlin (1949)."""
    modulus, poisson = SOFT
    radius, force = 3e-3, 0.2

    def shear(r):
        return force / (2 * np.pi * radius) / np.sqrt(radius**2 - r**2)

    moved = _surface_under(shear, cerruti, radius, fraction * radius, points=400)
    expected = (2 - poisson) * force * 2 * (1 + poisson) / (8 * modulus * radius)
    assert moved[0] == pytest.approx(expected, rel=5e-3)
    assert moved[1] == pytest.approx(0, abs=1e-9 * expected)


def test_point_loads_are_reciprocal() -> None:
    """Betti: swapping the two points and the two directions gives the same displacement."""
    x, y = 0.7e-3, -1.9e-3
    assert boussinesq(x, y, 1.0, *SOFT)[0] == pytest.approx(cerruti(-x, -y, 1.0, *SOFT)[2])
    assert cerruti(x, y, 1.0, *SOFT)[1] == pytest.approx(cerruti(y, x, 1.0, *SOFT)[1])


def test_an_incompressible_surface_does_not_mix_normal_and_tangential() -> None:
    assert boussinesq(1e-3, 2e-3, 1.0, 1e5, 0.5)[:2] == pytest.approx([0, 0])
    assert cerruti(1e-3, 2e-3, 1.0, 1e5, 0.5)[2] == 0


def test_point_loads_take_arrays() -> None:
    x, y = np.meshgrid([1e-3, 2e-3], [1e-3, 3e-3, 4e-3], indexing="ij")
    for load in (boussinesq, cerruti):
        field = load(x, y, 0.3, *SOFT)
        assert field.shape == (2, 3, 3)
        np.testing.assert_allclose(field[1, 2], load(2e-3, 4e-3, 0.3, *SOFT))
