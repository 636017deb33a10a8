"""Closed forms of the neo-Hookean material against its energy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from benchmarks.independent.formulas import (
    confined_stress,
    oedometric_modulus,
    simple_shear_stress,
    uniaxial_stress,
)

SOFT = (0.145e6, 0.45)


def _energy(gradient: np.ndarray, modulus: float, poisson: float):
    """Return W(F) as defined by `Body`, also for complex F."""
    shear = modulus / (2 * (1 + poisson))
    bulk = modulus / (3 * (1 - 2 * poisson))
    volume = np.linalg.det(gradient)
    trace = np.sum(gradient * gradient)
    isochoric = shear / 2 * (volume ** (-2 / 3) * trace - 3)
    return isochoric + bulk / 2 * ((volume**2 - 1) / 2 - np.log(volume))


def _nominal_stress(gradient: np.ndarray, modulus: float, poisson: float) -> np.ndarray:
    """Return P = dW/dF (3, 3) by complex steps, exact to round-off."""
    stress = np.empty((3, 3))
    for index in np.ndindex(3, 3):
        stepped = gradient.astype(complex)
        stepped[index] += 1e-30j
        stress[index] = _energy(stepped, modulus, poisson).imag / 1e-30
    return stress


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.45, 0.499])
@pytest.mark.parametrize("stretch", [0.4, 0.8, 1.0, 1.3])
def test_confined_stress_is_the_slope_of_the_energy(stretch: float, poisson: float) -> None:
    expected = _nominal_stress(np.diag([1.0, 1.0, stretch]), 1.0, poisson)[2, 2]
    assert confined_stress(stretch, 1.0, poisson) == pytest.approx(expected, rel=1e-10, abs=1e-13)


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.45, 0.499])
@pytest.mark.parametrize("stretch", [0.4, 0.8, 1.0, 1.3])
def test_uniaxial_stress_is_the_slope_of_the_energy_with_free_sides(
    stretch: float, poisson: float
) -> None:
    def widened(side: float) -> float:
        return float(_energy(np.diag([side, side, stretch]), 1.0, poisson))

    side = minimize_scalar(widened, bounds=(0.4, 2.5), method="bounded", options={"xatol": 1e-12}).x
    stress = _nominal_stress(np.diag([side, side, stretch]), 1.0, poisson)
    # The minimum is flat, so its position and the stress have only half the digits.
    assert stress[0, 0] == pytest.approx(0, abs=1e-5)
    assert uniaxial_stress(stretch, 1.0, poisson) == pytest.approx(stress[2, 2], abs=1e-5)


def test_small_strains_meet_the_linear_moduli() -> None:
    step = 1e-6
    assert (
        confined_stress(1 + step, *SOFT) - confined_stress(1 - step, *SOFT)
    ) / 2 / step == pytest.approx(oedometric_modulus(*SOFT), rel=1e-6)
    assert (
        uniaxial_stress(1 + step, *SOFT) - uniaxial_stress(1 - step, *SOFT)
    ) / 2 / step == pytest.approx(SOFT[0], rel=1e-6)
    assert confined_stress(1.0, *SOFT) == uniaxial_stress(1.0, *SOFT) == 0


def test_a_nearly_incompressible_bar_follows_the_textbook() -> None:
    """P = G (s - 1/s^2), G = E/3: Treloar."""
    for stretch in (0.5, 1.7):
        expected = (stretch - stretch**-2) / 3
        assert uniaxial_stress(stretch, 1.0, 0.4999999) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("amount", [0.0, 0.1, -0.7, 1.5])
def test_simple_shear_is_the_slope_of_the_energy(amount: float) -> None:
    gradient = np.eye(3)
    gradient[0, 2] = amount
    stress = _nominal_stress(gradient, *SOFT)
    shear, normal = simple_shear_stress(amount, *SOFT)
    assert shear == pytest.approx(stress[0, 2], abs=1e-6)
    assert normal == pytest.approx(stress[2, 2], abs=1e-6)
    assert shear == pytest.approx(amount * SOFT[0] / 2.9)
