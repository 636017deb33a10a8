"""Motions: tip position over time, and invalid motions."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.scene import Motion, from_target, press
from trajectories import PressShear


def test_a_press_touches_then_goes_to_each_depth_at_its_speed() -> None:
    motion = press([1e-3, 3e-3, 2e-3], at=(4e-3, -2e-3), speed=5e-3)
    assert motion.tip == tuple((4e-3, -2e-3, z) for z in (0.0, -1e-3, -3e-3, -2e-3))
    assert motion.time == pytest.approx((0, 0.2, 0.6, 0.8))
    assert motion.depth_max == 3e-3
    assert len(motion) == 4


@given(st.floats(0.1e-3, 2e-3), st.floats(0.1e-3, 2e-3), st.floats(-4, 4), st.integers(1, 7))
def test_a_loop_has_four_even_phases_and_ends_where_it_began(
    depth: float, shear: float, angle: float, steps: int
) -> None:
    motion = press([depth], shear=shear, angle=angle, steps=steps, at=(1e-3, 2e-3))
    tip, time = np.array(motion.tip), np.array(motion.time)
    assert len(motion) == 4 * steps + 1
    np.testing.assert_allclose(tip[-1], tip[0], atol=1e-15)
    np.testing.assert_allclose(tip[steps], (1e-3, 2e-3, -depth), atol=1e-15)
    aside = tip[2 * steps] - tip[steps]
    np.testing.assert_allclose(
        aside, (shear * math.cos(angle), shear * math.sin(angle), 0), atol=1e-15
    )
    travel = np.linalg.norm(np.diff(tip, axis=0), axis=1)
    np.testing.assert_allclose(travel[:steps], depth / steps, rtol=1e-9)
    np.testing.assert_allclose(travel[steps : 3 * steps], shear / steps, rtol=1e-9)
    np.testing.assert_allclose(travel / np.diff(time), 10e-3, rtol=1e-9)


def test_a_hold_goes_down_in_its_ramp_and_stays() -> None:
    motion = press([1e-3], hold=4.0, steps=4, speed=1e-3 / 0.5)
    depth, time = -np.array(motion.tip)[:, 2], np.array(motion.time)
    np.testing.assert_allclose(depth, [0, 0.25e-3, 0.5e-3, 0.75e-3, *[1e-3] * 5])
    np.testing.assert_allclose(time, [0, 0.125, 0.25, 0.375, 0.5, 1.5, 2.5, 3.5, 4.5])


def test_a_target_of_a_plan_is_followed_through_every_move() -> None:
    plan = PressShear(
        step_x=4e-3,
        step_y=4e-3,
        depth_step=0.3e-3,
        depth_max=0.9e-3,
        angle_step=math.pi / 2,
        shear=1e-3,
    )
    target = next(iter(plan.targets()))
    motion = from_target(plan, target, steps=3, speed=20e-3)
    moves = plan.moves(target)
    assert len(motion) == 3 * len(moves) + 1
    corners = [moves[0].start, *(move.end for move in moves)]
    np.testing.assert_allclose(motion.tip[::3], corners, atol=1e-15)
    assert motion.depth_max == pytest.approx(target.depth)
    length = sum(math.dist(move.start, move.end) for move in moves)
    assert motion.time[-1] == pytest.approx(length / 20e-3)


def test_a_tip_that_never_presses_has_no_depth() -> None:
    assert Motion(tip=((0.0, 0.0, 2e-3),), time=(0.0,)).depth_max == 0.0
