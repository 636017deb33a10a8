"""The integral equation against its limits, tables, and the shape it must have."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss
from scipy.integrate import quad

from benchmarks.independent.formulas import (
    HAYES_KAPPA,
    HAYES_POISSON,
    HAYES_PRINTED,
    LayerContact,
    cone,
    cone_contact_radius,
    dimitriadis,
    flat_punch,
    hayes_kappa,
    hertz,
    hertz_contact_radius,
    hertz_displacement,
    hertz_pressure,
    layer_cone,
    layer_deficit,
    layer_paraboloid,
    layer_punch,
    layer_sphere,
    oedometric_modulus,
    reduced_modulus,
    sphere,
    sphere_contact_radius,
)
from benchmarks.independent.formulas.layer_contact import deficit_rule
from tests.support.few import few

SOFT = (0.145e6, 0.45)
GEL = (4e-3, *SOFT)
HEIGHTS = {
    layer_punch: lambda r, size: np.zeros_like(r),
    layer_paraboloid: lambda r, size: r**2 / (2 * size),
    layer_sphere: lambda r, size: size - np.sqrt(size**2 - r**2),
    layer_cone: lambda r, size: r / math.tan(size),
}
SIZES = {layer_punch: 3e-3, layer_paraboloid: 4e-3, layer_sphere: 4e-3, layer_cone: 1.2}
SHAPES = list(HEIGHTS)


def _name(shape: object) -> str:
    return str(getattr(shape, "__name__", shape))


@pytest.mark.parametrize("poisson", [0.3, 0.45, 0.5])
@pytest.mark.parametrize("shape", SHAPES, ids=_name)
def test_the_surface_takes_the_shape_of_the_indenter(shape, poisson: float) -> None:
    contact: LayerContact = shape(1e-3, SIZES[shape], 4e-3, 0.145e6, poisson)
    r = contact.contact_radius * np.array([0.0, 0.2, 0.5, 0.8, 0.99])
    expected = HEIGHTS[shape](r, SIZES[shape]) - 1e-3
    # The density of a cone has a kink at the axis, so its transform converges more slowly.
    tolerance = 1e-6 if shape is layer_cone else 1e-11
    np.testing.assert_allclose(contact.displacement(r), expected, rtol=0, atol=1e-3 * tolerance)


@pytest.mark.parametrize("base", ["bonded", "frictionless"])
@pytest.mark.parametrize("shape", few(SHAPES, 2), ids=_name)
def test_the_pressure_adds_up_to_the_force(shape, base) -> None:
    contact: LayerContact = shape(1e-3, SIZES[shape], *GEL, base=base)
    place, weight = leggauss(64)
    angle = np.pi / 4 * (place + 1)
    r = contact.contact_radius * np.sin(angle)
    ring = np.pi / 4 * weight * contact.contact_radius * np.cos(angle)
    force = 2 * np.pi * np.sum(contact.pressure(r) * r * ring)
    assert force == pytest.approx(contact.force, rel=1e-6)
    assert contact.pressure(1.001 * contact.contact_radius) == 0


@pytest.mark.parametrize("poisson", [0.3, 0.45, 0.5])
@pytest.mark.parametrize("ratio", few([0.3, 2.0, 10.0, 40.0], 2))
def test_more_points_change_nothing(ratio: float, poisson: float) -> None:
    coarse = layer_punch(1.0, ratio, 1.0, 1.0, poisson)
    fine = layer_punch(1.0, ratio, 1.0, 1.0, poisson, points=128)
    assert coarse.force == pytest.approx(fine.force, rel=1e-11)
    outside = 1.5 * ratio
    assert coarse.displacement(outside) == pytest.approx(
        float(fine.displacement(outside)), rel=0, abs=2e-11
    )


@pytest.mark.parametrize("reach", [0.0, 0.7, 3.0, 20.0])
def test_the_rule_for_waves_integrates_what_it_promises(reach: float) -> None:
    k, weight = deficit_rule(1.0, 0.5, "bonded", reach)
    expected, _ = quad(
        lambda alpha: float(layer_deficit(alpha, 0.5)) * math.cos(alpha * reach),
        0,
        24,
        epsabs=1e-13,
        epsrel=1e-13,
        limit=400,
    )
    assert np.sum(weight * np.cos(k * reach)) == pytest.approx(expected, abs=1e-12)


def test_a_thick_layer_is_a_half_space() -> None:
    depth, deep = 1e-3, 4e3
    punch = layer_punch(depth, 3e-3, deep, *SOFT)
    assert punch.force == pytest.approx(flat_punch(depth, 3e-3, *SOFT), rel=1e-5)
    edge = flat_punch(depth, 3e-3, *SOFT) / (2 * np.pi * 3e-3) / math.sqrt(3e-3**2 - 1e-3**2)
    assert punch.pressure(1e-3) == pytest.approx(edge, rel=1e-5)

    paraboloid = layer_paraboloid(depth, 4e-3, deep, *SOFT)
    assert paraboloid.force == pytest.approx(hertz(depth, 4e-3, *SOFT), rel=1e-5)
    assert paraboloid.contact_radius == pytest.approx(hertz_contact_radius(depth, 4e-3), rel=1e-5)
    r = np.array([0.0, 1e-3, 1.9e-3, 2.5e-3, 9e-3])
    np.testing.assert_allclose(
        paraboloid.pressure(r), hertz_pressure(r, depth, 4e-3, *SOFT), rtol=1e-4
    )
    np.testing.assert_allclose(
        paraboloid.displacement(r), hertz_displacement(r, depth, 4e-3), rtol=1e-4
    )

    true = layer_sphere(depth, 4e-3, deep, *SOFT)
    assert true.force == pytest.approx(sphere(depth, 4e-3, *SOFT), rel=1e-5)
    assert true.contact_radius == pytest.approx(sphere_contact_radius(depth, 4e-3), rel=1e-5)

    blunt = layer_cone(depth, 1.2, deep, *SOFT)
    assert blunt.force == pytest.approx(cone(depth, 1.2, *SOFT), rel=1e-5)
    assert blunt.contact_radius == pytest.approx(cone_contact_radius(depth, 1.2), rel=1e-5)
    # Under a cone p = E*/2 cot(angle) arcosh(a/r): Sneddon (1965).
    steep = reduced_modulus(*SOFT) / 2 / math.tan(1.2)
    expected = steep * math.acosh(blunt.contact_radius / 0.5e-3)
    assert blunt.pressure(0.5e-3) == pytest.approx(expected, rel=1e-4)
    assert blunt.pressure(0.0) == math.inf


def _widening(exponent: float, limits: list[tuple[float, float, float]]) -> list[float]:
    """Return the widening, in heights, at which a punch has its force by the film's law."""
    return [((force / film) ** (1 / exponent) - 1) * ratio for ratio, force, film in limits]


@pytest.mark.parametrize(
    ("base", "poisson", "exponent", "film"),
    [
        ("bonded", 0.3, 2, lambda ratio: math.pi * ratio**2 * oedometric_modulus(1.0, 0.3)),
        ("frictionless", 0.3, 2, lambda ratio: math.pi * ratio**2 * reduced_modulus(1.0, 0.3)),
        # Reynolds: p = 3 G d (a^2 - r^2) / (4 h^3), F = 3 pi G d a^4 / (8 h^3).
        ("bonded", 0.5, 4, lambda ratio: math.pi / 8 * ratio**4),
    ],
    ids=["springs", "sliding springs", "squeezed film"],
)
def test_a_thin_layer_carries_a_punch_as_a_film(base, poisson, exponent, film) -> None:
    """The rest is an edge effect: the punch acts as if wider by a fixed fraction of the height."""
    limits = []
    for ratio in (20.0, 40.0):
        force = layer_punch(1.0, ratio, 1.0, 1.0, poisson, base=base).force
        limits.append((ratio, force, film(ratio)))
    half, full = _widening(exponent, limits)
    assert 0 < full < 1.5
    assert half == pytest.approx(full, rel=2e-3)


@pytest.mark.parametrize("shape", [layer_paraboloid, layer_sphere, layer_cone], ids=_name)
def test_stiffness_is_that_of_a_punch_as_wide_as_the_contact(shape) -> None:
    size, step = SIZES[shape], 1e-7
    middle = shape(1e-3, size, *GEL)
    rise = shape(1e-3 + step, size, *GEL).force - shape(1e-3 - step, size, *GEL).force
    punch = layer_punch(1.0, middle.contact_radius, *GEL).force
    assert rise / (2 * step) == pytest.approx(punch, rel=1e-6)


@pytest.mark.parametrize(
    ("depth", "force"),
    [(0.1e-3, 0.01833), (0.3e-3, 0.11019), (0.5e-3, 0.26300), (1e-3, 0.89449), (1.5e-3, 1.86182)],
)
def test_the_bench_sphere_gives_the_known_forces(depth: float, force: float) -> None:
    assert layer_sphere(depth, 4e-3, *GEL).force == pytest.approx(force, rel=2e-4)


def test_kappa_is_that_of_the_table() -> None:
    for ratio, row in HAYES_KAPPA.items():
        for poisson, kappa in zip(HAYES_POISSON, row, strict=True):
            assert hayes_kappa(ratio, poisson) == pytest.approx(kappa, abs=1.01e-4)


def test_kappa_is_that_of_the_paper_within_its_digits() -> None:
    for ratio, kappa in HAYES_PRINTED.items():
        assert 0 < hayes_kappa(ratio, 0.5) / kappa - 1 + 1e-3 < 1.1e-2


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
        exact = layer_paraboloid(c**2, 1.0, 1.0, 1.0, poisson).force
        series = sum(term * c**power for power, term in enumerate(terms))
        assert exact == pytest.approx(series * hertz(c**2, 1.0, 1.0, poisson), rel=2 * c**5)


def test_the_corrected_published_series_for_an_incompressible_layer_agrees() -> None:
    """Garcia & Garcia, Biophys. J. 114 (2018) 2923: paraboloid, nu = 0.5."""
    for c in (0.1, 0.2, 0.3, 0.4):
        exact = layer_paraboloid(c**2, 1.0, 1.0, 1.0, 0.5).force / hertz(c**2, 1.0, 1.0, 0.5)
        published = 1 + 1.133 * c + 1.497 * c**2 + 1.469 * c**3 + 0.755 * c**4
        assert exact == pytest.approx(published, rel=3e-3)


def test_dimitriadis_holds_for_shallow_presses_and_only_for_them() -> None:
    def error(ratio: float, poisson: float) -> float:
        exact = layer_paraboloid(ratio**2, 1.0, 1.0, 1.0, poisson).force
        return dimitriadis(ratio**2, 1.0, 1.0, 1.0, poisson) / exact - 1

    for poisson in (0.3, 0.45, 0.5):
        assert abs(error(0.1, poisson)) < 3e-3
        assert abs(error(0.25, poisson)) < 2e-2
    measured = [error(ratio, 0.45) for ratio in (0.35, 0.5, 1.0)]
    np.testing.assert_allclose(measured, [-0.031, -0.063, -0.136], atol=1e-3)


def test_dimitriadis_has_the_published_numbers_for_an_incompressible_layer() -> None:
    for c in (0.1, 0.25, 1.0):
        series = dimitriadis(c**2, 1.0, 1.0, 1.0, 0.5) / hertz(c**2, 1.0, 1.0, 0.5)
        # The paper prints the opposite sign for the last term at nu = 0.5.
        printed = 1 + 1.133 * c + 1.283 * c**2 + 0.769 * c**3 - 0.0975 * c**4
        assert series == pytest.approx(printed, rel=5e-4)


def test_a_press_that_cannot_be_is_refused() -> None:
    for shape in SHAPES:
        with pytest.raises(ValueError, match="depth"):
            shape(0.0, SIZES[shape], *GEL)
    with pytest.raises(ValueError, match="contact ends"):
        layer_sphere(1.0, 1e-3, *GEL)
