"""Lee and Radok's forces against quadrature, springs and dashpots, and limits."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from benchmarks.independent.formulas import (
    flat_punch,
    hereditary,
    hertz,
    layer_sphere,
    lee_radok_punch,
    lee_radok_sphere,
    relaxation_modulus,
)

SOFT = (0.145e6, 0.45)
RATIOS, TIMES = (0.5, 0.2), (0.3, 4.0)
RAMP = np.array([0.0, 0.2, 0.5, 0.9, 2.0, 6.0])
DEPTH = np.array([0.0, 0.3e-3, 0.4e-3, 1.0e-3, 1.0e-3, 1.2e-3])


def _history(elastic_rate, until: float) -> float:
    """Return int_0^until E(until - s)/E rate(s) ds, interval by interval."""
    corners = [0.0, *[float(time) for time in RAMP if 0 < time < until], until]
    total = 0.0
    for low, high in pairwise(corners):
        # s = low + span x^2 removes the square root at first contact.
        value, _ = quad(
            lambda x, low=low, span=high - low: (
                float(relaxation_modulus(until - low - span * x * x, 1.0, RATIOS, TIMES))
                * elastic_rate(low + span * x * x)
                * 2
                * span
                * x
            ),
            0,
            1,
            epsabs=0,
            epsrel=1e-11,
        )
        total += value
    return total


def _speed(time: float) -> float:
    piece = min(int(np.searchsorted(RAMP, time, side="right")) - 1, len(RAMP) - 2)
    return float((DEPTH[piece + 1] - DEPTH[piece]) / (RAMP[piece + 1] - RAMP[piece]))


def test_sphere_is_the_convolution_by_quadrature() -> None:
    force = lee_radok_sphere(RAMP, DEPTH, 4e-3, *SOFT, RATIOS, TIMES)
    unit = hertz(1.0, 4e-3, *SOFT)
    for time, value in zip(RAMP[1:], force[1:], strict=True):
        expected = _history(
            lambda s: unit * 1.5 * np.sqrt(np.interp(s, RAMP, DEPTH)) * _speed(s), float(time)
        )
        assert value == pytest.approx(expected, rel=1e-8)


def test_punch_is_a_spring_beside_springs_with_dashpots() -> None:
    """Each branch obeys f' = ratio k d' - f/time, here also during withdrawal of the punch."""
    depth = np.array([0.0, 0.4e-3, 0.4e-3, 1.0e-3, 0.9e-3, 0.95e-3])
    stiffness = flat_punch(1.0, 3e-3, *SOFT)
    branches = np.zeros(2)
    expected = [0.0]
    for index in range(1, len(RAMP)):
        speed = (depth[index] - depth[index - 1]) / (RAMP[index] - RAMP[index - 1])
        solved = solve_ivp(
            lambda _, f, speed=speed: np.array(RATIOS) * stiffness * speed - f / np.array(TIMES),
            (RAMP[index - 1], RAMP[index]),
            branches,
            rtol=1e-11,
            atol=1e-13,
        )
        branches = solved.y[:, -1]
        expected.append(stiffness * depth[index] + branches.sum())
    force = lee_radok_punch(RAMP, depth, 3e-3, *SOFT, RATIOS, TIMES)
    np.testing.assert_allclose(force, expected, rtol=1e-8, atol=1e-12)


def test_a_step_relaxes_along_the_modulus() -> None:
    time = [0.0, 0.1, 1.0, 50.0]
    held = [0.5e-3] * 4
    expected = relaxation_modulus(time, 1.0, RATIOS, TIMES)
    sphere = lee_radok_sphere(time, held, 4e-3, *SOFT, RATIOS, TIMES)
    np.testing.assert_allclose(sphere / hertz(0.5e-3, 4e-3, *SOFT), expected, rtol=1e-13)
    punch = lee_radok_punch(time, held, 3e-3, *SOFT, RATIOS, TIMES, kappa=2.0)
    np.testing.assert_allclose(punch / flat_punch(1e-3, 3e-3, *SOFT), expected, rtol=1e-13)


@pytest.mark.parametrize(("pace", "factor"), [(1e-7, 1.7), (1e7, 1.0)], ids=["at once", "at rest"])
def test_fast_is_the_modulus_at_once_and_slow_the_modulus_at_rest(
    pace: float, factor: float
) -> None:
    force = lee_radok_sphere(RAMP * pace, DEPTH, 4e-3, *SOFT, RATIOS, TIMES)
    expected = [factor * hertz(depth, 4e-3, *SOFT) for depth in DEPTH]
    np.testing.assert_allclose(force, expected, rtol=1e-5)


def test_no_branch_is_elastic() -> None:
    force = lee_radok_sphere(RAMP, DEPTH, 4e-3, *SOFT, (), ())
    np.testing.assert_allclose(force, [hertz(depth, 4e-3, *SOFT) for depth in DEPTH])


def test_finer_pieces_of_one_motion_change_nothing() -> None:
    fine = np.unique(np.concatenate([RAMP, np.linspace(0, 6, 501)]))
    depth = np.interp(fine, RAMP, DEPTH)
    coarse = lee_radok_sphere(RAMP, DEPTH, 4e-3, *SOFT, RATIOS, TIMES)
    force = lee_radok_sphere(fine, depth, 4e-3, *SOFT, RATIOS, TIMES)
    np.testing.assert_allclose(force[np.isin(fine, RAMP)], coarse, rtol=1e-9)


def test_any_elastic_force_may_relax_if_given_finely() -> None:
    fine = np.unique(np.concatenate([RAMP, np.linspace(0, 6, 6001)]))
    elastic = [hertz(float(depth), 4e-3, *SOFT) for depth in np.interp(fine, RAMP, DEPTH)]
    exact = lee_radok_sphere(RAMP, DEPTH, 4e-3, *SOFT, RATIOS, TIMES)
    force = hereditary(fine, elastic, RATIOS, TIMES)
    np.testing.assert_allclose(force[np.isin(fine, RAMP)], exact, rtol=1e-5, atol=1e-12)


def test_a_layer_relaxes_to_its_elastic_force() -> None:
    elastic = [0.0, layer_sphere(0.5e-3, 4e-3, 4e-3, *SOFT).force]
    force = hereditary([0.0, 1.0, 200.0], [*elastic, elastic[1]], RATIOS, TIMES)
    assert force[1] > 1.05 * elastic[1]
    assert force[2] == pytest.approx(elastic[1], rel=1e-9)


def test_histories_beyond_the_theory_are_refused() -> None:
    with pytest.raises(ValueError, match="depth: decreases"):
        lee_radok_sphere([0, 1, 2], [0, 1e-3, 0.9e-3], 4e-3, *SOFT, RATIOS, TIMES)
    with pytest.raises(ValueError, match="time: not increasing"):
        lee_radok_punch([0, 1, 1], [0, 1e-3, 1e-3], 4e-3, *SOFT, RATIOS, TIMES)
    with pytest.raises(ValueError, match="shape"):
        hereditary([0, 1], [0, 1, 2], RATIOS, TIMES)
