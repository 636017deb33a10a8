"""Closed forms and integral equations against quadrature, their limits and each other."""

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss
from numpy.typing import NDArray
from scipy.integrate import quad, solve_bvp
from scipy.linalg import expm
from scipy.optimize import minimize_scalar
from support.closed_forms import (
    boussinesq,
    cerruti,
    cone,
    confined_stress,
    flat_punch,
    hereditary,
    hertz,
    mindlin_displacement,
    mindlin_stick_radius,
    uniaxial_stress,
)

from benchmarks.independent.formulas import layer_sag, oedometric_modulus, reduced_modulus
from benchmarks.independent.linear_layer import (
    LinearLayer,
    deficit_rule,
    layer_deficit,
    layer_punch,
    layer_sphere,
)
from tests.support.few import few

Array = NDArray[np.float64]

SOFT = (0.145e6, 0.45)
GEL = LinearLayer(4e-3, *SOFT)
POISSON = [0.0, 0.3, 0.45, 0.4999, 0.5]


def unit(ratio: float, poisson: float, **how: Any) -> float:
    """Return the force of a punch as wide as `ratio` heights, of modulus and depth 1."""
    return layer_punch(1.0, ratio, LinearLayer(1.0, 1.0, poisson, **how)).force


# Waves on a layer.


def _ratio_from_elasticity(alpha: float, poisson: float) -> float:
    """Return L(alpha), integrating (U, W, T, S) from base to top through plane-strain elasticity.

    u = U sin kx, w = W cos kx, shear traction T sin kx, normal traction S cos kx; G = k = 1. The
    state's derivative contains lambda only in quotients that stay finite at nu = 0.5.
    """
    quotient = poisson / (1 - poisson)  # lambda / (lambda + 2 G)
    inverse = (1 - 2 * poisson) / (2 * (1 - poisson))  # G / (lambda + 2 G)
    system = np.array(
        [
            [0, 1, 1, 0],  # T = U' - W
            [-quotient, 0, 0, inverse],  # S = (lambda + 2 G) W' + lambda U
            [2 + 2 * quotient, 0, 0, quotient],  # T' = (lambda + 2 G) U + lambda W'
            [0, 0, -1, 0],  # S' = -T
        ]
    )
    # At the base U = W = 0: two amplitudes are free.
    top = expm(system * alpha)[:, [2, 3]]
    amplitude = np.linalg.solve(top[2:], [0.0, 1.0])
    return float(top[1] @ amplitude) / (1 - poisson)  # over 2 (1 - nu^2)/(E k) = (1 - nu)/G


@pytest.mark.parametrize("poisson", POISSON)
def test_waves_solve_the_equations_of_elasticity_and_keep_their_digits(poisson: float) -> None:
    for alpha in (0.1, 0.5, 1.0, 2.0, 4.0, 7.0):
        expected = _ratio_from_elasticity(alpha, poisson)
        assert 1 - layer_deficit(alpha, poisson) == pytest.approx(expected, rel=1e-9)
    waves = np.concatenate([np.geomspace(1e-2, 0.4, 12), [0.5, 1, 2, 5]])
    a, nu = waves.astype(np.longdouble), np.longdouble(poisson)
    kappa = 3 - 4 * nu
    above = 2 * kappa * np.sinh(2 * a) - 4 * a
    below = 2 * kappa * np.cosh(2 * a) + 1 + kappa**2 + 4 * a**2
    expected = (1 - above / below).astype(float)
    np.testing.assert_allclose(layer_deficit(waves, poisson), expected, rtol=2e-14)
    waves = np.concatenate([[0.0, 1e-300, 1e-30], np.geomspace(1e-8, 1e6, 200)])
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        deficit = layer_deficit(waves, poisson)
    assert np.all((deficit >= 0) & (deficit <= 1 + 5e-16))
    assert (deficit[0], deficit[-1]) == (1, 0)
    # It keeps its digits where it is small.
    k = float(3 - 4 * poisson)
    expected = (4 * 30.0**2 + 4 * 30.0 + 1 + k**2) * math.exp(-60.0) / k
    assert layer_deficit(30.0, poisson) == pytest.approx(expected, rel=1e-12)


# Contact with a layer.


@pytest.mark.parametrize("poisson", [0.3, 0.45, 0.5])
def test_the_surface_takes_the_shape_of_the_indenter(poisson: float) -> None:
    layer = LinearLayer(4e-3, 0.145e6, poisson)
    for contact, height in (
        (layer_punch(1e-3, 3e-3, layer), lambda r: 0 * r),
        (layer_sphere(1e-3, 4e-3, layer), lambda r: 4e-3 - np.sqrt(4e-3**2 - r**2)),
    ):
        r = contact.contact_radius * np.array([0.0, 0.2, 0.5, 0.8, 0.99])
        np.testing.assert_allclose(contact.displacement(r), height(r) - 1e-3, rtol=0, atol=1e-14)


@pytest.mark.parametrize("poisson", [0.3, 0.5])
@pytest.mark.parametrize("ratio", few([0.3, 2.0, 10.0], 2))
def test_more_points_change_nothing(ratio: float, poisson: float) -> None:
    assert unit(ratio, poisson) == pytest.approx(unit(ratio, poisson, points=128), rel=1e-11)


@pytest.mark.parametrize("reach", [0.0, 0.7, 20.0])
def test_the_rule_for_waves_integrates_what_it_promises(reach: float) -> None:
    k, weight = deficit_rule(LinearLayer(1.0, 1.0, 0.5), reach)
    expected, _ = quad(
        lambda alpha: float(layer_deficit(alpha, 0.5)) * math.cos(alpha * reach),
        *(0, 24),
        epsabs=1e-13,
        epsrel=1e-13,
        limit=400,
    )
    assert np.sum(weight * np.cos(k * reach)) == pytest.approx(expected, abs=1e-12)


def test_a_thick_layer_is_a_half_space() -> None:
    depth, deep, radius = 1e-3, LinearLayer(4e3, *SOFT), 4e-3
    punch = layer_punch(depth, 3e-3, deep)
    assert punch.force == pytest.approx(flat_punch(depth, 3e-3, *SOFT), rel=1e-5)
    # F = E* ((a^2 + R^2) artanh(a/R) - a R), d = a artanh(a/R): Sneddon (1965).
    true = layer_sphere(depth, radius, deep)
    across, turn = true.contact_radius, math.atanh(true.contact_radius / radius)
    assert across * turn == pytest.approx(depth, rel=1e-5)
    expected = reduced_modulus(*SOFT) * ((across**2 + radius**2) * turn - across * radius)
    assert true.force == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    ("poisson", "exponent", "film"),
    [
        (0.3, 2, math.pi * oedometric_modulus(1.0, 0.3)),
        # Reynolds: p = 3 G d (a^2 - r^2) / (4 h^3), F = 3 pi G d a^4 / (8 h^3).
        (0.5, 4, math.pi / 8),
    ],
    ids=["springs", "squeezed film"],
)
def test_a_thin_layer_carries_a_punch_as_a_film(poisson: float, exponent: int, film: float) -> None:
    """The rest is an edge effect: the punch acts as if wider by a fixed fraction of the height."""
    half, full = ((unit(ratio, poisson) / film) ** (1 / exponent) - ratio for ratio in (20, 40))
    assert 0 < full < 1.5
    assert half == pytest.approx(full, rel=2e-3)


def test_stiffness_is_that_of_a_punch_as_wide_as_the_contact() -> None:
    one, other = (layer_sphere(1e-3 + step, 4e-3, GEL).force for step in (1e-7, -1e-7))
    punch = layer_punch(1.0, layer_sphere(1e-3, 4e-3, GEL).contact_radius, GEL).force
    assert (one - other) / 2e-7 == pytest.approx(punch, rel=1e-6)


@pytest.mark.parametrize(("depth", "force"), [(0.1e-3, 0.01833), (0.5e-3, 0.263), (1.5e-3, 1.8618)])
def test_a_sphere_on_the_papers_gel_has_its_known_forces(depth: float, force: float) -> None:
    assert layer_sphere(depth, 4e-3, GEL).force == pytest.approx(force, rel=3e-4)


def test_a_punch_has_the_published_factors_of_a_layer() -> None:
    """Hayes' kappa, J. Biomech. 5 (1972) 541, whose integral equation is solved to convergence."""
    for ratio, row in {
        0.2: (1.2066, 1.2523, 1.2806),
        0.6: (1.7848, 2.0328, 2.2129),
        1.0: (2.4835, 3.0914, 3.6187),
        2.0: (4.3532, 6.4206, 9.1494),
    }.items():
        for poisson, kappa in zip((0.30, 0.45, 0.50), row, strict=True):
            found = unit(ratio, poisson) / flat_punch(1.0, ratio, 1.0, poisson)
            assert found == pytest.approx(kappa, abs=1.01e-4)


def _paraboloid(c: float, poisson: float) -> float:
    """Return the force over Hertz' at sqrt(R d)/h = c, by a sphere much larger than its contact."""
    depth, radius = c**2 / 1e3, 1e3
    exact = layer_sphere(depth, radius, LinearLayer(1.0, 1.0, poisson)).force
    return exact / hertz(depth, radius, 1.0, poisson)


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.45, 0.5])
def test_small_contacts_follow_the_expansion_of_the_equation(poisson: float) -> None:
    """F/F_Hertz in c = sqrt(R d)/h up to c^4, derived by hand.

    cos kt cos ks = 1 - k^2 (t^2 + s^2)/2 makes phi a parabola, with which
    c^2 = x^2 - p x^3 + 6/5 e x^5 - p e x^6 and F/F_Hertz = (x/c)^3 (1 + e x^3), x = a/h,
    p = 4/(3 pi) int (1 - L) d alpha, e = 2/(3 pi) int (1 - L) alpha^2 d alpha.
    """

    def moment(power: int) -> float:
        return quad(lambda alpha: float(layer_deficit(alpha, poisson)) * alpha**power, 0, 30)[0]

    p, e = 4 / (3 * math.pi) * moment(0), 2 / (3 * math.pi) * moment(2)
    terms = (1, 3 / 2 * p, 21 / 8 * p**2, 5 * p**3 - 4 / 5 * e, 1287 / 128 * p**4 - 18 / 5 * p * e)
    for c in (0.01, 0.03, 0.06):
        series = sum(term * c**power for power, term in enumerate(terms))
        assert _paraboloid(c, poisson) == pytest.approx(series, rel=2 * c**5 + 1e-9)


def test_the_published_series_for_an_incompressible_layer_agrees() -> None:
    """Garcia & Garcia, Biophys. J. 114 (2018) 2923: paraboloid, nu = 0.5."""
    for c in (0.1, 0.2, 0.3, 0.4):
        published = 1 + 1.133 * c + 1.497 * c**2 + 1.469 * c**3 + 0.755 * c**4
        assert _paraboloid(c, 0.5) == pytest.approx(published, rel=3e-3)


# All forces.

FORCES: dict[str, Callable[[float, float, float], float]] = {
    # Functions of depth [m], of the unit of all other lengths [m], and of the modulus [Pa].
    "hertz": lambda depth, length, modulus: hertz(depth, 4 * length, modulus, 0.45),
    "punch": lambda depth, length, modulus: flat_punch(depth, 3 * length, modulus, 0.45),
    "cone": lambda depth, length, modulus: cone(depth, 1.2, modulus, 0.45),
    "layer": lambda depth, length, modulus: (
        layer_sphere(depth, 4 * length, LinearLayer(4 * length, modulus, 0.45)).force
    ),
}


@pytest.mark.parametrize("name", FORCES)
def test_forces_grow_with_depth_as_the_modulus_and_as_the_square_of_lengths(name: str) -> None:
    force = FORCES[name]
    one = force(0.1, 1.0, 1.0)
    assert 0 < one < force(0.12, 1.0, 1.0)
    assert force(0.1, 1.0, 2e5) == pytest.approx(2e5 * one)
    assert force(0.1e-3, 1e-3, 1.0) == pytest.approx(1e-6 * one)


# Half-space.


@pytest.mark.parametrize("depth", [1e-5, 1.5e-3])
@pytest.mark.parametrize(
    ("force", "argument", "radius", "slope"),
    [
        (hertz, 4e-3, lambda d, radius: math.sqrt(radius * d), lambda x: x / 4e-3),
        (
            cone,
            1.2,
            lambda d, angle: 2 / math.pi * d * math.tan(angle),
            lambda x: 1 / math.tan(1.2),
        ),
    ],
    ids=["paraboloid", "cone"],
)
def test_forces_solve_the_integrals_of_the_profile(
    force: Any, argument: float, radius: Any, slope: Any, depth: float
) -> None:
    """d = a int z'(a sin) d, F = 2 E* int z' (a sin)^2 d: Galin and Sneddon."""
    a = radius(depth, argument)
    first = quad(lambda angle: slope(a * math.sin(angle)), 0, np.pi / 2)[0]
    assert a * first == pytest.approx(depth, rel=1e-10)
    second = quad(lambda angle: slope(a * math.sin(angle)) * math.sin(angle) ** 2, 0, np.pi / 2)[0]
    expected = 2 * reduced_modulus(*SOFT) * a**2 * second
    assert force(depth, argument, *SOFT) == pytest.approx(expected, rel=1e-8)
    assert force(0.0, 1.0, *SOFT) == force(-1e-3, 1.0, *SOFT) == flat_punch(-1e-3, 1.0, *SOFT) == 0


def _under(traction: Any, load: Any, x: float, y: float, radii: tuple[float, ...]) -> Array:
    """Return the surface displacement (3,) at (x, y) under traction(r), by a point load.

    Polar coordinates about the point; each chord is split at `radii`, where the traction has a
    kink, and sines remove the square roots at the ends of its parts.
    """
    place, weight = leggauss(24)
    total, count = np.zeros(3), 96
    for direction in (np.arange(count) + 0.5) * 2 * np.pi / count:
        ahead = np.array([math.cos(direction), math.sin(direction)])
        along, ends = x * ahead[0] + y * ahead[1], [0.0]
        for radius in radii:
            inside = along**2 - x * x - y * y + radius**2
            if inside > 0:
                both = (-along - math.sqrt(inside), -along + math.sqrt(inside))
                ends += [root for root in both if root > 0]
        for low, high in pairwise(sorted(ends)):
            distance = (high + low) / 2 + (high - low) / 2 * np.sin(np.pi / 2 * place)
            step = (high - low) / 2 * np.cos(np.pi / 2 * place) * np.pi / 2 * weight
            at_x, at_y = distance * ahead[0], distance * ahead[1]
            strength = traction(np.hypot(x + at_x, y + at_y)) * distance * step
            total += strength @ load(-at_x, -at_y, 1.0, *SOFT)
    return total * 2 * np.pi / count


@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.8])
def test_a_point_load_under_the_pressure_of_hertz_gives_the_paraboloid(fraction: float) -> None:
    depth, radius = 0.3e-3, 4e-3
    a = math.sqrt(radius * depth)
    peak = 3 * hertz(depth, radius, *SOFT) / (2 * math.pi * a**2)
    x = fraction * a
    moved = _under(lambda r: -peak * np.sqrt(1 - (r / a) ** 2), boussinesq, x, 0.0, (a,))
    assert moved[2] == pytest.approx(x**2 / (2 * radius) - depth, rel=1e-6)
    # u_r = -(1 - 2 nu)(1 + nu)/(3 E) p0 a^2/r (1 - (1 - r^2/a^2)^1.5): Johnson (1985), eq. 3.41b.
    modulus, poisson = SOFT
    drag = (1 - 2 * poisson) * (1 + poisson) / (3 * modulus) * peak * a
    inwards = -drag * (1 - (1 - fraction**2) ** 1.5) / fraction if fraction else 0.0
    assert moved[0] == pytest.approx(inwards, rel=1e-5, abs=1e-12)


def test_point_loads_are_reciprocal_and_take_arrays() -> None:
    """Betti: swapping the two points and the two directions gives the same displacement."""
    x, y = np.array([0.7e-3, 2e-3]), np.array([-1.9e-3, 1e-3])
    up, along = boussinesq(x, y, 1.0, *SOFT), cerruti(x, y, 1.0, *SOFT)
    assert up[:, 0] == pytest.approx(cerruti(-x, -y, 1.0, *SOFT)[:, 2])
    assert along[:, 1] == pytest.approx(cerruti(y, x, 1.0, *SOFT)[:, 1])
    assert along[1] == pytest.approx(cerruti(2e-3, 1e-3, 1.0, *SOFT))
    # Nothing mixes normal and tangential on an incompressible surface.
    assert boussinesq(1e-3, 2e-3, 1.0, 1e5, 0.5)[:2] == pytest.approx([0, 0])
    assert cerruti(1e-3, 2e-3, 1.0, 1e5, 0.5)[2] == 0


# Friction: normal force [N], coefficient, contact radius [m], modulus [Pa], Poisson's ratio.

NORMAL, COEFFICIENT, RADIUS = 0.5, 0.6, 1.4e-3
MOST = NORMAL * COEFFICIENT
SYSTEM = (NORMAL, COEFFICIENT, RADIUS, *SOFT)


@pytest.mark.parametrize("fraction", [0.2, 0.7, 0.95])
def test_the_sticking_core_moves_as_one_and_its_rim_stays_behind(fraction: float) -> None:
    """Traction 3 mu N / (2 pi a^3) (sqrt(a^2 - r^2) - sqrt(c^2 - r^2)), by Cerruti's point load."""
    core = mindlin_stick_radius(fraction * MOST, *SYSTEM[:3])

    def traction(r: Array) -> Array:
        slip, stick = (np.sqrt(np.maximum(each**2 - r**2, 0)) for each in (RADIUS, core))
        return 3 * MOST / (2 * math.pi * RADIUS**3) * (slip - stick)

    shift = mindlin_displacement(fraction * MOST, *SYSTEM)
    for x, y in ((0.0, 0.0), (0.6 * core, 0.0), (-0.3 * core, 0.8 * core)):
        moved = _under(traction, cerruti, x, y, (core, RADIUS))
        assert moved[0] == pytest.approx(shift, rel=1e-5)
        assert abs(moved[1]) < 1e-5 * shift
    rim = _under(traction, cerruti, 0.99 * RADIUS, 0.0, (core, RADIUS))[0]
    assert 0 < rim < shift


def test_a_small_push_meets_the_stiffness_of_full_stick() -> None:
    """8 a G / (2 - nu)."""
    stiffness = 8 * RADIUS * SOFT[0] / (2 * (1 + SOFT[1])) / (2 - SOFT[1])
    small = mindlin_displacement(1e-6 * MOST, *SYSTEM)
    assert small == pytest.approx(1e-6 * MOST / stiffness, rel=1e-6)
    assert mindlin_displacement(-1e-6 * MOST, *SYSTEM) == -small
    assert mindlin_stick_radius(MOST, *SYSTEM[:3]) == 0


# Large strain.


def _energy(gradient: Any, poisson: float) -> Any:
    """Return W(F) of modulus 1 as defined by `Body`, also for complex F."""
    shear, bulk = 1 / (2 * (1 + poisson)), 1 / (3 * (1 - 2 * poisson))
    volume = np.linalg.det(gradient)
    isochoric = shear / 2 * (volume ** (-2 / 3) * np.sum(gradient * gradient) - 3)
    return isochoric + bulk / 2 * ((volume**2 - 1) / 2 - np.log(volume))


def _nominal(gradient: Any, poisson: float) -> Array:
    """Return P = dW/dF (3, 3) by complex steps, exact to round-off."""
    stress = np.empty((3, 3))
    for index in np.ndindex(3, 3):
        stepped = gradient.astype(complex)
        stepped[index] += 1e-30j
        stress[index] = _energy(stepped, poisson).imag / 1e-30
    return stress


@pytest.mark.parametrize("poisson", [0.0, 0.45, 0.499])
@pytest.mark.parametrize("stretch", [0.4, 1.0, 1.3])
def test_stress_is_the_slope_of_the_energy(stretch: float, poisson: float) -> None:
    confined = _nominal(np.diag([1.0, 1.0, stretch]), poisson)[2, 2]
    assert confined_stress(stretch, 1.0, poisson) == pytest.approx(confined, rel=1e-10, abs=1e-13)
    side = minimize_scalar(
        lambda side: float(_energy(np.diag([side, side, stretch]), poisson)),
        bounds=(0.4, 2.5),
        method="bounded",
        options={"xatol": 1e-12},
    ).x
    free = _nominal(np.diag([side, side, stretch]), poisson)
    # The minimum is flat, so its position and the stress have only half the digits.
    assert uniaxial_stress(stretch, 1.0, poisson) == pytest.approx(free[2, 2], abs=1e-5)


def test_small_strains_meet_the_linear_moduli_and_a_rubber_bar_the_textbook() -> None:
    for stress, modulus in (
        (confined_stress, oedometric_modulus(*SOFT)),
        (uniaxial_stress, SOFT[0]),
    ):
        slope = (stress(1 + 1e-6, *SOFT) - stress(1 - 1e-6, *SOFT)) / 2e-6
        assert slope == pytest.approx(modulus, rel=1e-6)
        assert stress(1.0, *SOFT) == 0
    # P = G (s - 1/s^2), G = E/3: Treloar.
    for stretch in (0.5, 1.7):
        expected = (stretch - stretch**-2) / 3
        assert uniaxial_stress(stretch, 1.0, 0.4999999) == pytest.approx(expected, rel=1e-5)


# Viscosity and weight.

RATIOS, TIMES = (0.5, 0.2), (0.3, 4.0)
RAMP = np.array([0.0, 0.2, 0.5, 0.9, 2.0, 6.0])
DEPTH = np.array([0.0, 0.3e-3, 0.4e-3, 1.0e-3, 1.0e-3, 1.2e-3])


def _modulus(time: Any) -> Any:
    return 1 + sum(ratio * np.exp(-time / each) for ratio, each in zip(RATIOS, TIMES, strict=True))


def test_a_linear_force_relaxes_as_the_convolution_by_quadrature() -> None:
    force = 1e3 * DEPTH
    relaxed = hereditary(RAMP, force, RATIOS, TIMES)
    for end in range(1, len(RAMP)):
        pieces = [
            (force[k + 1] - force[k])
            / (RAMP[k + 1] - RAMP[k])
            * quad(lambda s, end=end: _modulus(RAMP[end] - s), *RAMP[k : k + 2])[0]
            for k in range(end)
        ]
        assert relaxed[end] == pytest.approx(sum(pieces), rel=1e-8)
    # Finer pieces of the same force change nothing.
    fine = np.unique(np.concatenate([RAMP, np.linspace(0, 6, 601)]))
    again = hereditary(fine, np.interp(fine, RAMP, force), RATIOS, TIMES)
    np.testing.assert_allclose(again[np.isin(fine, RAMP)], relaxed, rtol=1e-9)


@pytest.mark.parametrize(
    ("pace", "branches", "factor"),
    [(1e-7, (RATIOS, TIMES), 1.7), (1e7, (RATIOS, TIMES), 1.0), (1.0, ((), ()), 1.0)],
    ids=["at once", "at rest", "without branches"],
)
def test_a_force_is_the_elastic_one_times_the_modulus_of_its_pace(
    pace: float, branches: tuple[Any, Any], factor: float
) -> None:
    relaxed = hereditary(RAMP * pace, DEPTH, *branches)
    np.testing.assert_allclose(relaxed, factor * DEPTH, rtol=1e-5)


def test_a_step_relaxes_along_the_modulus() -> None:
    time = [0.0, 0.1, 1.0, 50.0]
    expected = _modulus(np.array(time))
    np.testing.assert_allclose(hereditary(time, [1.0] * 4, RATIOS, TIMES), expected, rtol=1e-13)


HEIGHT, DENSITY = 4e-3, 1070.0


def test_the_sag_of_a_wide_layer_is_in_balance_with_its_weight() -> None:
    acceleration, shear = (3.0, -4.0, -9.81), SOFT[0] / (2 * (1 + SOFT[1]))
    z = np.linspace(-HEIGHT, 0, 9)
    sag = layer_sag(z, acceleration, HEIGHT, DENSITY, *SOFT)
    for axis, stiffness in enumerate((shear, shear, oedometric_modulus(*SOFT))):
        # Heights are scaled by the layer's, so that the solver's tolerance is meaningful.
        pull = DENSITY * acceleration[axis] * HEIGHT**2 / stiffness
        solved = solve_bvp(
            lambda _, state, pull=pull: np.vstack([state[1], np.full_like(state[0], -pull)]),
            lambda base, top: np.array([base[0], top[1]]),
            np.linspace(-1, 0, 9),
            np.zeros((2, 9)),
            tol=1e-9,
        )
        np.testing.assert_allclose(sag[:, axis], solved.sol(z / HEIGHT)[0], rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize(
    ("refused", "words"),
    [
        (lambda: layer_punch(0.0, 3e-3, GEL), "depth"),
        (lambda: layer_sphere(1.0, 1e-3, GEL), "contact ends"),
        (lambda: mindlin_displacement(1.01 * MOST, *SYSTEM), "mu N"),
        (lambda: mindlin_stick_radius(math.nan, *SYSTEM[:3]), "mu N"),
        (lambda: hereditary([0, 1, 1], [0, 1, 1], RATIOS, TIMES), "time: not increasing"),
        (lambda: hereditary([0, 1], [0, 1, 2], RATIOS, TIMES), "shape"),
    ],
)
def test_presses_beyond_the_theory_are_refused(refused: Callable[[], object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        refused()
