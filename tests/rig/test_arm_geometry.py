import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from rig.core.geometry import (
    compose,
    invert,
    matrix_from_vector,
    rotation_between,
    transform,
    turn,
    vector_from_matrix,
)
from rig.devices.arm.emulated_arm import POSTURE, find_joints, flange_pose, solve_joints

unit = st.floats(-1.0, 1.0).map(lambda x: round(x, 6))
axes = (
    st.tuples(unit, unit, unit)
    .filter(lambda v: math.hypot(*v) > 0.1)
    .map(lambda v: np.array(v) / math.hypot(*v))
)
angles = st.one_of(
    st.floats(0.0, math.pi),
    # Numerically critical angles: zero, nearly zero, nearly half a turn, half a turn.
    st.sampled_from([0.0, 1e-15, 1e-9, 1e-5, math.pi - 1e-5, math.pi - 1e-9, math.pi]),
)
vectors = st.builds(lambda axis, angle: axis * angle, axes, angles)
poses = st.builds(
    lambda place, vector: np.concatenate([place, vector]),
    st.tuples(unit, unit, unit).map(np.array),
    vectors,
)


def same_pose(found, expected, atol=1e-12) -> None:
    assert_allclose(found[..., :3], expected[..., :3], atol=atol)
    turns = matrix_from_vector(found[..., 3:]), matrix_from_vector(expected[..., 3:])
    assert_allclose(*turns, atol=atol)


@given(vectors)
def test_matrices_are_rotations(vector):
    matrix = matrix_from_vector(vector)
    assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1.0)


@given(vectors)
def test_vector_and_matrix_are_inverse_up_to_half_a_turn(vector):
    matrix = matrix_from_vector(vector)
    back = vector_from_matrix(matrix)
    assert_allclose(matrix_from_vector(back), matrix, atol=1e-12)
    assert np.linalg.norm(back) <= math.pi + 1e-12
    if np.linalg.norm(vector) < math.pi - 1e-6:
        assert_allclose(back, vector, atol=1e-9)


@pytest.mark.parametrize("axis", np.vstack([np.eye(3), -np.eye(3), [[0.6, 0.8, 0.0]]]))
def test_half_a_turn_keeps_its_axis_but_for_the_sign(axis):
    back = vector_from_matrix(matrix_from_vector(axis * math.pi))
    assert np.linalg.norm(back) == pytest.approx(math.pi)
    assert abs(back @ axis) == pytest.approx(math.pi)


@given(poses, poses, poses)
def test_composition_is_associative(a, b, c):
    same_pose(compose(compose(a, b), c), compose(a, compose(b, c)))


@given(poses)
def test_a_pose_and_its_inverse_cancel(pose):
    same_pose(compose(pose, invert(pose)), np.zeros(6))
    same_pose(compose(invert(pose), pose), np.zeros(6))


@given(poses, poses)
def test_composition_transforms_points_one_after_the_other(a, b):
    points = np.array([[0.1, -0.2, 0.3], [0.0, 0.0, 0.0]])
    assert_allclose(
        transform(compose(a, b), points), transform(a, transform(b, points)), atol=1e-12
    )


@given(poses, poses)
def test_the_rotation_between_two_poses_turns_one_into_the_other(a, b):
    turned = turn(rotation_between(a, b), a[3:])
    assert_allclose(matrix_from_vector(turned), matrix_from_vector(b[3:]), atol=1e-12)


@given(st.lists(poses, min_size=1, max_size=5))
def test_a_batch_is_its_members(members):
    batch = np.stack(members)
    assert_allclose(invert(batch), np.stack([invert(pose) for pose in members]))
    assert_allclose(
        compose(batch, batch[::-1]),
        np.stack([compose(a, b) for a, b in zip(members, members[::-1], strict=True)]),
    )


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
    same_pose(flange_pose(joints), goal, 1e-8)


@pytest.mark.parametrize("vector", [(math.pi, 0, 0), (0, math.pi, 0), (2.2214, 2.2214, 0)])
@pytest.mark.parametrize("place", [(-0.4, -0.2, 0.3), (0.4, -0.1, 0.2), (0.3, 0.3, 0.15)])
def test_a_tool_pointing_down_is_found_all_around(place, vector):
    goal = np.array([*place, *vector], float)
    joints = find_joints(goal)
    assert joints is not None
    assert_allclose(flange_pose(joints)[:3], place, atol=1e-8)


def test_out_of_reach_is_none():
    assert find_joints(np.array([1.5, 0.0, 0.3, math.pi, 0.0, 0.0])) is None
