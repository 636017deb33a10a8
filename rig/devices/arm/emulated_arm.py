"""Kinematics of the emulated arm: the TCP pose, and movements as generators.

One `next()` of a movement is one controller cycle (2 ms). Movements run on the TCP pose; joint
angles, the costliest part, are solved for on request only.
"""

import math
from collections.abc import Iterator

import numpy as np

from rig.core.geometry import (
    Array,
    compose,
    invert,
    matrix_from_vector,
    rotation_between,
    turn,
    vector_from_matrix,
)

# UR5e forward and inverse kinematics, for the emulated controller only.
#
# The real controller has its own calibrated model; nothing that moves a real arm uses this one.

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

# Elbow up, tool pointing down [rad]: default posture of the emulated arm.
POSTURE = (0.0, -math.pi / 2, math.pi / 2, -math.pi / 2, -math.pi / 2, 0.0)

# Every UR5e joint turns at most this far either way [rad].
JOINT_LIMIT = 2 * math.pi


def joint_frames(joints: Array) -> list[Array]:
    """Return the base-frame matrices (4, 4) of base, then each joint; the last is the flange."""
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
    """Return the flange pose (6,) in the base frame [m, rad] at joint angles (6,) [rad]."""
    flange = joint_frames(joints)[-1]
    return np.concatenate([flange[:3, 3], vector_from_matrix(flange[:3, :3])])


def solve_joints(flange: Array, seed: Array) -> Array | None:
    """Return joint angles (6,) [rad] near `seed` that put the flange at pose (6,), or None.

    Damped least squares with a step limit: near `seed` it converges in two or three steps. None
    means out of reach, too close to a singularity, or beyond the joint limits.
    """
    goal_turn = matrix_from_vector(flange[3:])
    joints = np.array(seed, np.float64)
    for _ in range(100):
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
    """Return joint angles (6,) [rad] for any flange pose, starting from POSTURE turned to it."""
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


# Controller cycle of the e-Series [s].
CYCLE = 0.002

# Path length that takes as long as a turn of 1 rad: UR uses one movel profile for both [m/rad].
_ARM_LENGTH = 0.2

Movement = Iterator[None]


class Wrist:
    """Estimate of the force at the tool by an arm of this seed: wrong gain, bias, drift, noise.

    The errors are those that Universal Robots states for the e-Series (accuracy 4 N, precision
    3.5 N), and a gain that is up to 30 % wrong, as with a wrong payload or a moment on the flange.
    The true payload is that of the controller plus `payload_error` [kg].
    """

    GAIN, BIAS, DRIFT, NOISE = 0.3, 4.0, 0.02, 0.15
    """Largest error of the gain, bias [N] and drift [N/s]; standard deviation of the noise [N]."""

    def __init__(self, seed: int, payload_error: float = 0.0) -> None:
        self._rng = np.random.default_rng(seed)
        self.gain = 1.0 + float(self._rng.uniform(-self.GAIN, self.GAIN))
        self._bias = np.zeros(6)
        self._bias[:3] = self._rng.uniform(-self.BIAS, self.BIAS, 3)
        self._bias[2] -= 9.81 * payload_error
        self._drift = np.zeros(6)
        self._drift[:3] = self._rng.uniform(-self.DRIFT, self.DRIFT, 3)

    def reported(self, wrench: Array, t: float) -> Array:
        """Return what the arm reports for a true wrench (6,) [N, N m] at time `t` [s]."""
        noise = self._rng.normal(0.0, self.NOISE, 6) * (1.0, 1.0, 1.0, 0.1, 0.1, 0.1)
        return self.gain * wrench + self._bias + self._drift * t + noise


class PoseError:
    """Errors of a reported pose: noise of its position [m], and a vector that flips its sign.

    If flipped, every other tenth of a second has the opposite vector of the same rotation.
    """

    def __init__(self, jitter: float, flipped: bool, seed: int) -> None:
        self._jitter, self._flipped = jitter, flipped
        self._rng = np.random.default_rng(seed)

    def reported(self, pose: Array, tick: int) -> Array:
        """Return the arm's report for a pose (6,) [m, rad] in its cycle `tick`."""
        position, vector = pose[:3] + self._rng.normal(0.0, self._jitter, 3), pose[3:]
        angle = float(np.linalg.norm(vector))
        if self._flipped and tick * CYCLE % 0.2 < 0.1 and angle > 0:
            vector = vector * (1 - math.tau / angle)
        return np.concatenate([position, vector])


class Robot:
    """Ideal arm that follows its commands exactly.

    TCP pose (6,) in the base frame and TCP (6,) in the flange frame, as in the installation, are
    those at power on [m, rad].
    """

    def __init__(self, pose: Array, tcp: Array) -> None:
        self.pose = np.array(pose, np.float64)
        self.tcp = np.array(tcp, np.float64)
        self.speed = np.zeros(6)
        self.slider = 1.0
        joints = find_joints(compose(self.pose, invert(self.tcp)))
        if joints is None:
            raise ValueError(f"pose {self.pose.tolist()}: out of reach of a UR5e")
        self._joints = joints
        self._joints_pose = self.pose

    def end_cycle(self, before: Array) -> None:
        """Set the TCP speed from the pose one cycle ago."""
        if before is self.pose:
            if self.speed.any():
                self.speed = np.zeros(6)
            return
        linear = (self.pose[:3] - before[:3]) / CYCLE
        same = np.array_equal(self.pose[3:], before[3:])
        angular = np.zeros(3) if same else rotation_between(before, self.pose) / CYCLE
        self.speed = np.concatenate([linear, angular])

    @property
    def joints(self) -> Array:
        """Joint angles (6,) [rad] of the current pose."""
        if self._joints_pose is not self.pose:
            solved = self.solve(self.pose)
            if solved is not None:
                self._joints = solved
            self._joints_pose = self.pose
        return self._joints

    def solve(self, pose: Array) -> Array | None:
        """Return joint angles (6,) [rad] near the current ones with the TCP at `pose`, or None."""
        return solve_joints(compose(pose, invert(self.tcp)), self._joints)

    def set_tcp(self, tcp: Array) -> None:
        """Change the TCP (6,) in the flange frame [m, rad]; the flange stays where it is."""
        flange = compose(self.pose, invert(self.tcp))
        self.tcp = np.array(tcp, np.float64)
        self.pose = compose(flange, self.tcp)

    def move_linear(self, goal: Array, acceleration: float, speed: float) -> Movement:
        """Move straight to TCP pose `goal` (6,), with trapezoidal speed [m/s^2, m/s]."""
        start = self.pose
        way = goal[:3] - start[:3]
        rotation = rotation_between(start, goal)
        angle = float(np.linalg.norm(rotation))
        length = max(float(np.linalg.norm(way)), angle * _ARM_LENGTH)
        for fraction in self._profile(length, acceleration, speed):
            vector = turn(rotation * fraction, start[3:]) if angle > 1e-12 else start[3:]
            self.pose = np.concatenate([start[:3] + way * fraction, vector])
            yield
        self.pose = np.array(goal, np.float64)
        yield

    def _profile(self, length: float, acceleration: float, speed: float) -> Iterator[float]:
        """Yield the fraction of `length` travelled after each cycle, at the speed slider."""
        if length < 1e-9:
            return
        acceleration, speed = max(acceleration, 1e-6), max(speed, 1e-6)
        ramp = min(speed / acceleration, math.sqrt(length / acceleration))
        top = acceleration * ramp
        total = ramp + length / top
        t = CYCLE * self.slider
        while t < total:
            if t < ramp:
                travelled = acceleration * t * t / 2
            elif t < total - ramp:
                travelled = top * (t - ramp / 2)
            else:
                travelled = length - acceleration * (total - t) ** 2 / 2
            yield travelled / length
            t += CYCLE * self.slider

    def stop(self, deceleration: float) -> Movement:
        """Decelerate along the current direction until at rest [m/s^2]."""
        speed = self.speed
        turning = float(np.linalg.norm(speed[3:])) * _ARM_LENGTH
        full = max(float(np.linalg.norm(speed[:3])), turning)
        left = full
        while left > deceleration * CYCLE:
            left -= deceleration * CYCLE
            self._drift(speed * (left / full))
            yield
        yield

    def _drift(self, speed: Array) -> None:
        vector = self.pose[3:]
        if speed[3:].any():
            vector = turn(speed[3:] * CYCLE, vector)
        self.pose = np.concatenate([self.pose[:3] + speed[:3] * CYCLE, vector])
