"""Sag and natural frequencies of a wide layer against the equations of one column."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_bvp
from scipy.linalg import eigh

from benchmarks.independent.formulas import (
    compression_frequency,
    layer_sag,
    oedometric_modulus,
    shear_frequency,
)

HEIGHT, DENSITY, MODULUS, POISSON = 4e-3, 1070.0, 0.145e6, 0.45
STIFFNESS = (
    MODULUS / (2 * (1 + POISSON)),
    MODULUS / (2 * (1 + POISSON)),
    oedometric_modulus(MODULUS, POISSON),
)


def test_oedometric_modulus_is_bulk_and_shear_together() -> None:
    bulk, shear = MODULUS / (3 * (1 - 2 * POISSON)), STIFFNESS[0]
    assert oedometric_modulus(MODULUS, POISSON) == pytest.approx(bulk + 4 / 3 * shear)


def test_sag_is_in_balance_with_the_weight() -> None:
    acceleration = (3.0, -4.0, -9.81)
    z = np.linspace(-HEIGHT, 0, 9)
    sag = layer_sag(z, acceleration, HEIGHT, DENSITY, MODULUS, POISSON)
    for axis, stiffness in enumerate(STIFFNESS):
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


def test_the_base_carries_the_whole_weight() -> None:
    step = 1e-9
    slope = layer_sag(-HEIGHT + step, (0, 0, -9.81), HEIGHT, DENSITY, MODULUS, POISSON)[2] / step
    assert STIFFNESS[2] * slope == pytest.approx(-DENSITY * 9.81 * HEIGHT, rel=1e-6)


@pytest.mark.parametrize("overtone", [0, 1, 2])
def test_frequencies_are_those_of_a_column_of_elements(overtone: int) -> None:
    count = 400
    length = HEIGHT / count
    stiff = np.diag(np.full(count, 2.0)) - np.eye(count, k=1) - np.eye(count, k=-1)
    mass = np.diag(np.full(count, 4.0)) + np.eye(count, k=1) + np.eye(count, k=-1)
    stiff[-1, -1], mass[-1, -1] = 1, 2  # the free top; the fixed base is omitted
    squares = eigh(
        stiff / length, mass * length / 6 * DENSITY, eigvals_only=True, subset_by_index=[0, 2]
    )
    for frequency, stiffness in (
        (shear_frequency, STIFFNESS[0]),
        (compression_frequency, STIFFNESS[2]),
    ):
        expected = np.sqrt(stiffness * squares[overtone]) / (2 * np.pi)
        found = frequency(HEIGHT, DENSITY, MODULUS, POISSON, overtone=overtone)
        assert found == pytest.approx(expected, rel=1e-4)
