from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from rig.core.geometry import matrix_from_vector
from rig.devices.arm.emulated_arm import POSTURE, find_joints, flange_pose, solve_joints

nudges = st.tuples(*[st.floats(-0.3, 0.3)] * 6).map(np.array)


def test_the_posture_points_the_tool_down():
    pose = flange_pose(np.array(POSTURE))
    assert_allclose(matrix_from_vector(pose[3:]) @ [0, 0, 1], [0, 0, -1], atol=1e-12)
    assert np.linalg.norm(pose[3:]) == pytest.approx(math.pi)


@given(nudges)
def test_solving_undoes_forward_kinematics(nudge):
    goal = flange_pose(np.array(POSTURE) + nudge)
    joints = solve_joints(goal, np.array(POSTURE))
    assert joints is not None
    found = flange_pose(joints)
    assert_allclose(found[:3], goal[:3], atol=1e-8)
    assert_allclose(matrix_from_vector(found[3:]), matrix_from_vector(goal[3:]), atol=1e-8)


@pytest.mark.parametrize("vector", [(math.pi, 0, 0), (0, math.pi, 0), (2.2214, 2.2214, 0)])
@pytest.mark.parametrize("place", [(-0.4, -0.2, 0.3), (0.4, -0.1, 0.2), (0.3, 0.3, 0.15)])
def test_a_tool_pointing_down_is_found_all_around(place, vector):
    goal = np.array([*place, *vector], float)
    joints = find_joints(goal)
    assert joints is not None
    assert_allclose(flange_pose(joints)[:3], place, atol=1e-8)


def test_out_of_reach_is_none():
    assert find_joints(np.array([1.5, 0.0, 0.3, math.pi, 0.0, 0.0])) is None
