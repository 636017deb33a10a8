"""The layer's compliance, wave by wave, against its differential equations."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sim.layer.spectral import compliance

THICKNESS, SHEAR = 4e-3, 5e4

Array = NDArray[np.float64]


def _chebyshev(count: int) -> tuple[Array, Array]:
    """Return points from 1 to -1, and the matrix that differentiates between them."""
    points = np.cos(np.pi * np.arange(count + 1) / count)
    weight = np.ones(count + 1)
    weight[[0, -1]] = 2
    weight *= (-1.0) ** np.arange(count + 1)
    distance = points[:, None] - points[None, :] + np.eye(count + 1)
    matrix = np.outer(weight, 1 / weight) / distance
    return points, matrix - np.diag(matrix.sum(axis=1))


def _collocated(wave_number: float, poisson: float, across: bool = False) -> Array:
    """Return top displacement (i U, W) by tractions (i T, S), from the differential equations."""
    lame = 2 * SHEAR * poisson / (1 - 2 * poisson)
    stiff, k = lame + 2 * SHEAR, wave_number
    _, d = _chebyshev(48)
    d = d * 2 / THICKNESS
    one, nil = np.eye(len(d)), np.zeros_like(d)
    if across:
        equations = SHEAR * (d @ d - k * k * one)
        equations[0], equations[-1] = SHEAR * d[0], one[-1]
        load = one[:, 0]
        return np.linalg.solve(equations, load)[:1]
    along = np.hstack([SHEAR * d @ d - stiff * k * k * one, (SHEAR + lame) * k * d])
    upright = np.hstack([-(SHEAR + lame) * k * d, stiff * d @ d - SHEAR * k * k * one])
    count = len(d)
    along[0] = SHEAR * np.concatenate([d[0], k * one[0]])
    upright[0] = np.concatenate([-lame * k * one[0], stiff * d[0]])
    along[-1] = np.concatenate([one[-1], nil[-1]])
    upright[-1] = np.concatenate([nil[-1], one[-1]])
    load = np.zeros((2 * count, 2))
    load[0, 0] = load[count, 1] = 1
    return np.linalg.solve(np.vstack([along, upright]), load)[[0, count]]


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.45, 0.4995])
@pytest.mark.parametrize("alpha", [0.05, 0.7, 2.0, 9.0])
def test_a_wave_moves_the_top_as_the_equations_of_elasticity_say(
    alpha: float, poisson: float
) -> None:
    k = alpha / THICKNESS
    found = compliance(np.array([k]), thickness=THICKNESS, shear_modulus=SHEAR, poisson=poisson)
    along, upright = _collocated(k, poisson)
    # Displacements and tractions (i U, W), (i T, S): i * coupling * S is i U, so U = coupling * S.
    scale = found.from_along[0]
    assert found.from_along[0] == pytest.approx(along[0], rel=1e-6)
    assert found.from_normal[0] == pytest.approx(upright[1], rel=1e-6)
    assert found.coupling[0] == pytest.approx(along[1], abs=1e-6 * scale)
    assert found.coupling[0] == pytest.approx(upright[0], abs=1e-6 * scale)
    assert found.from_across[0] == pytest.approx(_collocated(k, poisson, True)[0], rel=1e-6)


def test_normal_waves_agree_with_the_textbook_form() -> None:
    k = np.geomspace(1e-3, 1e5, 50) / THICKNESS
    for poisson in (0.0, 0.45, 0.49995):
        found = compliance(k, thickness=THICKNESS, shear_modulus=SHEAR, poisson=poisson)
        # The half-space's, times (2 kappa sinh 2a - 4 a) / (2 kappa cosh 2a + 1 + kappa^2 + 4 a^2):
        # Hayes et al., J. Biomech. 5 (1972) 541, here without overflow.
        a, kappa = (k * THICKNESS).astype(np.longdouble), 3 - 4 * np.longdouble(poisson)
        once = np.exp(-2 * a)
        above = kappa * (1 - once**2) - 4 * a * once
        below = kappa * (1 + once**2) + (1 + kappa**2 + 4 * a**2) * once
        expected = (1 - poisson) / (SHEAR * k) * (above / below).astype(float)
        np.testing.assert_allclose(found.from_normal, expected, rtol=1e-9)


def test_short_waves_see_a_half_space_and_none_overflows() -> None:
    poisson = 0.3
    k = np.array([1e2, 1e4, 1e6]) / THICKNESS
    found = compliance(k, thickness=THICKNESS, shear_modulus=SHEAR, poisson=poisson)
    np.testing.assert_allclose(found.from_normal * SHEAR * k, 1 - poisson, rtol=1e-12)
    np.testing.assert_allclose(found.from_along * SHEAR * k, 1 - poisson, rtol=1e-12)
    np.testing.assert_allclose(found.from_across * SHEAR * k, 1, rtol=1e-12)
    np.testing.assert_allclose(found.coupling * SHEAR * k, poisson - 0.5, rtol=1e-12)


def test_long_waves_end_in_simple_shear_and_confined_compression() -> None:
    poisson = 0.45
    k = np.array([0.0, 1e-4 / THICKNESS])
    found = compliance(k, thickness=THICKNESS, shear_modulus=SHEAR, poisson=poisson)
    confined = SHEAR * (2 - 2 * poisson) / (1 - 2 * poisson)
    np.testing.assert_allclose(found.from_normal, THICKNESS / confined, rtol=1e-6)
    np.testing.assert_allclose(found.from_along, THICKNESS / SHEAR, rtol=1e-6)
    np.testing.assert_allclose(found.from_across, THICKNESS / SHEAR, rtol=1e-6)
    np.testing.assert_allclose(found.coupling[0], 0)


@pytest.mark.parametrize("poisson", [0.0, 0.45, 0.49995])
def test_no_wave_gives_energy_away(poisson: float) -> None:
    k = np.geomspace(1e-4, 1e6, 400) / THICKNESS
    found = compliance(k, thickness=THICKNESS, shear_modulus=SHEAR, poisson=poisson)
    assert (found.from_along > 0).all()
    assert (found.from_across > 0).all()
    assert (found.from_along * found.from_normal > found.coupling**2).all()
