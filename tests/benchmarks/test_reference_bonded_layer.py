"""The layer's kernel against the equations of elasticity, its limits and extended precision."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from benchmarks.independent.formulas import (
    edge_decay,
    layer_compliance,
    layer_deficit,
    layer_ratio,
    reduced_modulus,
)

POISSON = [0.0, 0.3, 0.45, 0.49, 0.4999, 0.5]
ANY_LAYER = [("bonded", nu) for nu in POISSON] + [("frictionless", 0.3)]


def _ratio_from_elasticity(alpha: float, poisson: float, base: str) -> float:
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
    transferred = expm(system * alpha)
    # At the base W = 0 and U = 0 (bonded) or T = 0 (frictionless): two amplitudes are free.
    start = [2, 3] if base == "bonded" else [0, 3]
    top = transferred[:, start]
    amplitude = np.linalg.solve(top[2:], [0.0, 1.0])
    sinking = float(top[1] @ amplitude)
    return sinking / (1 - poisson)  # over 2 (1 - nu^2)/(E k) = (1 - nu)/G


@pytest.mark.parametrize(("base", "poisson"), ANY_LAYER)
def test_ratio_solves_the_equations_of_elasticity(base, poisson: float) -> None:
    for alpha in (0.1, 0.5, 1.0, 2.0, 4.0, 7.0):
        expected = _ratio_from_elasticity(alpha, poisson, base)
        assert layer_ratio(alpha, poisson, base) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("poisson", POISSON)
def test_ratio_keeps_its_digits_where_the_textbook_form_loses_them(poisson: float) -> None:
    alpha = np.concatenate([np.geomspace(1e-2, 0.4, 12), np.linspace(0.45, 0.55, 11), [1, 5, 20]])
    a, nu = alpha.astype(np.longdouble), np.longdouble(poisson)
    kappa = 3 - 4 * nu
    above = 2 * kappa * np.sinh(2 * a) - 4 * a
    below = 2 * kappa * np.cosh(2 * a) + 1 + kappa**2 + 4 * a**2
    # Extended precision also loses digits where 2 sinh - 4 a nearly cancels, but far fewer.
    np.testing.assert_allclose(
        layer_ratio(alpha, poisson), (above / below).astype(float), rtol=2e-14
    )


@pytest.mark.parametrize(("base", "poisson"), ANY_LAYER)
def test_ratio_and_deficit_are_safe_from_nothing_to_a_million(base, poisson: float) -> None:
    alpha = np.concatenate([[0.0, 1e-300, 1e-30], np.geomspace(1e-8, 1e6, 200)])
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        ratio = layer_ratio(alpha, poisson, base)
        deficit = layer_deficit(alpha, poisson, base)
    assert np.all(np.isfinite(ratio))
    assert np.all(ratio >= 0)
    np.testing.assert_allclose(ratio + deficit, 1, rtol=0, atol=5e-16)
    assert ratio[0] == 0
    assert ratio[-1] == 1
    assert deficit[-1] == 0


def test_deficit_keeps_its_digits_where_the_ratio_is_one() -> None:
    alpha = 30.0
    expected = (4 * alpha**2 + 4 * alpha + 1 + 1.2**2) * np.exp(-2 * alpha) / 1.2
    assert layer_deficit(alpha, 0.45) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.45, 0.49])
def test_long_waves_feel_the_oedometric_modulus(poisson: float) -> None:
    oedometric = (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson))
    for wave_number in (0.0, 1e-6):
        compliance = layer_compliance(wave_number, 2.0, 1.0, poisson)
        assert compliance == pytest.approx(2.0 / oedometric, rel=1e-6)


def test_long_waves_squeeze_an_incompressible_layer_like_a_viscous_film() -> None:
    """Lubrication: the film's compliance is h^3 k^2 / (3 G), and zero for k = 0."""
    wave_number, thickness = 1e-5, 1.0
    expected = thickness**3 * wave_number**2 / (3 * (1 / 3))
    assert layer_compliance(wave_number, thickness, 1.0, 0.5) == pytest.approx(expected, rel=1e-8)
    assert layer_compliance(0.0, thickness, 1.0, 0.5) == 0


def test_short_waves_feel_a_half_space() -> None:
    expected = 2 / (reduced_modulus(2.0, 0.3) * 50.0)
    for base in ("bonded", "frictionless"):
        assert layer_compliance(50.0, 1.0, 2.0, 0.3, base) == pytest.approx(expected, rel=1e-12)


def test_long_waves_on_a_sliding_base_feel_plane_strain() -> None:
    for wave_number in (0.0, 1e-6):
        compliance = layer_compliance(wave_number, 2.0, 1.0, 0.3, "frictionless")
        assert compliance == pytest.approx(2.0 / reduced_modulus(1.0, 0.3), rel=1e-6)


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.45, 0.5])
def test_edge_decay_is_the_slowest_free_mode_of_the_layer(poisson: float) -> None:
    kappa = 3 - 4 * poisson

    def denominator(alpha):
        return 2 * kappa * np.cosh(2 * alpha) + 1 + kappa**2 + 4 * alpha**2

    def slope(alpha):
        return 4 * kappa * np.sinh(2 * alpha) + 8 * alpha

    rate = edge_decay(poisson)
    assert abs(denominator(1j * rate)) < 1e-12
    # Newton's method from the whole upper half plane: no root has a smaller imaginary part.
    real, imaginary = np.meshgrid(np.linspace(0, 5, 60), np.linspace(0.05, 4, 60))
    alpha = real + 1j * imaginary
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for _ in range(60):
            alpha = alpha - denominator(alpha) / slope(alpha)
        found = alpha[np.abs(denominator(alpha)) < 1e-8]
    assert found.size > 100
    assert np.min(np.abs(found.imag)) == pytest.approx(rate, rel=1e-6)


def test_edge_decay_of_an_incompressible_layer_is_the_fixed_point_of_the_cosine() -> None:
    assert edge_decay(0.5) == pytest.approx(0.7390851332151607, rel=1e-14)
