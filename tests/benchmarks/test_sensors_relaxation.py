"""Hysteresis of a press: areas, branches, and the ratio for a given energy loss."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.twin.relaxation import fitted, hysteresis, relaxed
from sim.errors import SceneError
from sim.scene import Viscosity

DEPTH = np.linspace(0.0, 1e-3, 9)
FORCE = 4.0 * (DEPTH / 1e-3) ** 1.1


def test_what_comes_up_as_it_went_down_loses_nothing() -> None:
    way = np.concatenate([DEPTH, DEPTH[-2::-1]])
    assert hysteresis(way, np.interp(way, DEPTH, FORCE)) == pytest.approx(0.0, abs=1e-12)


def test_the_loss_is_area_between_over_area_under() -> None:
    depth = np.array([0.0, 1.0, 2.0, 1.0, 0.0])
    assert hysteresis(depth, np.array([0.0, 2.0, 4.0, 1.0, 0.0])) == pytest.approx(1 / 4)


def test_a_branch_that_never_relaxes_only_stiffens() -> None:
    slow = Viscosity(ratios=(0.5,), times=(1e6,))
    depth, force = relaxed(DEPTH, FORCE, slow, speed=5e-3)
    np.testing.assert_allclose(force, 1.5 * np.interp(depth, DEPTH, FORCE), rtol=1e-3, atol=1e-4)


def test_a_ramp_of_a_linear_spring_relaxes_as_its_closed_form() -> None:
    """F = k v (t + ratio tau (1 - exp(-t / tau))) on the way down."""
    linear, time, ratio, speed = 4e3, 0.1, 0.3, 5e-3
    branch = Viscosity(ratios=(ratio,), times=(time,))
    depth, force = relaxed(DEPTH, linear * DEPTH, branch, speed=speed)
    half = len(depth) // 2 + 1
    t = depth[:half] / speed
    expected = linear * speed * (t + ratio * time * (1 - np.exp(-t / time)))
    np.testing.assert_allclose(force[:half], expected, rtol=1e-9, atol=1e-9)


def test_the_skin_lets_go_before_the_way_is_back() -> None:
    _, force = relaxed(DEPTH, FORCE, Viscosity((1.0,), (0.1,)), speed=5e-3)
    assert force.min() == 0.0
    assert (force[-5:] == 0).all()


@pytest.mark.parametrize("fraction", [0.1, 0.2])
def test_the_fitted_ratio_loses_the_wanted_share(fraction: float) -> None:
    branches = fitted(DEPTH, FORCE, (0.05, 0.5), speed=5e-3, fraction=fraction)
    assert branches.ratios[0] == branches.ratios[1]
    lost = hysteresis(*relaxed(DEPTH, FORCE, branches, speed=5e-3))
    assert lost == pytest.approx(fraction, abs=1e-5)


def test_a_share_that_no_ratio_loses_is_refused() -> None:
    with pytest.raises(SceneError, match=r"fraction: 0\.99; allowed with times \(0\.05,\) s"):
        fitted(DEPTH, FORCE, (0.05,), speed=5e-3, fraction=0.99)


def test_a_way_that_turns_twice_is_refused() -> None:
    with pytest.raises(SceneError, match="down once, then up once"):
        hysteresis(np.array([0.0, 1.0, 0.5, 1.0]), np.ones(4))
