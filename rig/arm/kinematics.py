"""UR5e forward and inverse kinematics, for the emulated controller only.

The real controller has its own calibrated model; nothing that moves a real arm uses this one.
"""

from __future__ import annotations

import math

import numpy as np

from rig.arm.rotation import Array, matrix_from_vector, vector_from_matrix

# Nominal Denavit-Hartenberg rows (a [m], d [m], alpha [rad]) of the UR5e, as Universal Robots
# publishes them.
_ROWS = (
    (0.0, 0.1625, math.pi / 2),
    (-0.425, 0.0, 0.0),
    (-0.3922, 0.0, 0.0),
    (0.0, 0.1333, math.pi / 2),
    (0.0, 0.0997, -math.pi / 2),
    (0.0, 0.0996, 0.0),
)

POSTURE = (0.0, -math.pi / 2, math.pi / 2, -math.pi / 2, -math.pi / 2, 0.0)
"""Elbow up, tool pointing down [rad]: where the emulated arm stands when not told otherwise."""

JOINT_LIMIT = 2 * math.pi
"""Every UR5e joint turns at most this far either way [rad]."""


def joint_frames(joints: Array) -> list[Array]:
    """Matrices (4, 4) in the base frame: the base, then joint by joint; the last is the flange."""
    frame = np.eye(4)
    frames = [frame]
    for (a, d, alpha), angle in zip(_ROWS, joints, strict=True):
        ct, st, ca, sa = math.cos(angle), math.sin(angle), math.cos(alpha), math.sin(alpha)
        frame = frame @ np.array(
            [
                [ct, -st * ca, st * sa, a * ct],
                [st, ct * ca, -ct * sa, a * st],
                [0.0, sa, ca, d],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
        frames.append(frame)
    return frames


def flange_pose(joints: Array) -> Array:
    """Pose (6,) of the flange in the base frame [m, rad] at joint angles (6,) [rad]."""
    flange = joint_frames(joints)[-1]
    return np.concatenate([flange[:3, 3], vector_from_matrix(flange[:3, :3])])


def solve_joints(flange: Array, seed: Array, *, iterations: int = 100) -> Array | None:
    """Joint angles (6,) [rad] near `seed` that put the flange at pose (6,), or None.

    Damped least squares with a step limit: near `seed` it converges in two or three steps; None
    means out of reach, too close to a singularity, or beyond the joint limits.
    """
    goal_turn = matrix_from_vector(flange[3:])
    joints = np.array(seed, np.float64)
    for _ in range(iterations):
        frames = joint_frames(joints)
        end = frames[-1]
        error = np.concatenate(
            [flange[:3] - end[:3, 3], vector_from_matrix(goal_turn @ end[:3, :3].T)]
        )
        if np.abs(error).max() < 1e-9:
            return joints if np.abs(joints).max() <= JOINT_LIMIT else None
        axes = np.stack([frame[:3, 2] for frame in frames[:6]])
        arms = end[:3, 3] - np.stack([frame[:3, 3] for frame in frames[:6]])
        jacobian = np.vstack([np.cross(axes, arms).T, axes.T])
        # Damping falls with the error: safe far away, quadratic at the end.
        damping = 1e-3 * min(1.0, float(error @ error))
        step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping * np.eye(6), error)
        joints = joints + step * min(1.0, 0.5 / max(float(np.abs(step).max()), 1e-12))
    return None


def find_joints(flange: Array) -> Array | None:
    """Joint angles (6,) [rad] for any flange pose, starting from POSTURE turned towards it."""
    home = math.atan2(*flange_pose(np.array(POSTURE))[1::-1])
    bearing = math.atan2(flange[1], flange[0])
    for wrist in (0.0, math.pi / 2, -math.pi / 2, math.pi):
        seed = np.array(POSTURE)
        seed[0] += math.remainder(bearing - home, 2 * math.pi)
        seed[5] += wrist
        joints = solve_joints(flange, seed)
        if joints is not None:
            return joints
    return None
