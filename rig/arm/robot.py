"""The emulated arm itself: where the TCP is, and its movements as generators.

One `next()` of a movement is one controller cycle (2 ms). Movements run on the TCP pose; joint
angles follow when somebody asks for them, since solving for them is what would cost the most.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from rig.arm.kinematics import find_joints, flange_pose, solve_joints
from rig.arm.rotation import Array, compose, invert, rotation_between, turn

CYCLE = 0.002
"""Controller cycle of the e-Series [s]."""

_ARM_LENGTH = 0.2
"""A turn of 1 rad takes as long as this many metres: UR ties both in one movel profile [m/rad]."""

Movement = Iterator[None]


class Robot:
    """An arm that goes where it is told, exactly.

    Args:
        pose: TCP pose (6,) in the base frame at power on [m, rad].
        tcp: TCP (6,) in the flange frame at power on, as in the installation [m, rad].

    Raises:
        ValueError: The UR5e cannot reach `pose`.
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
        """Joint angles (6,) [rad] of the present pose."""
        if self._joints_pose is not self.pose:
            solved = self.solve(self.pose)
            if solved is not None:
                self._joints = solved
            self._joints_pose = self.pose
        return self._joints

    def solve(self, pose: Array) -> Array | None:
        """Joint angles (6,) [rad] near the present ones with the TCP at `pose`, or None."""
        return solve_joints(compose(pose, invert(self.tcp)), self._joints)

    def set_tcp(self, tcp: Array) -> None:
        """Change the TCP (6,) in the flange frame [m, rad]; the flange stays where it is."""
        flange = compose(self.pose, invert(self.tcp))
        self.tcp = np.array(tcp, np.float64)
        self.pose = compose(flange, self.tcp)

    def move_linear(self, goal: Array, acceleration: float, speed: float) -> Movement:
        """Straight to TCP pose `goal` (6,) with a trapezoidal speed profile [m/s^2, m/s]."""
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

    def move_joints(self, goal: Array, acceleration: float, speed: float) -> Movement:
        """All joints together to `goal` (6,) [rad], the slowest sets the pace [rad/s^2, rad/s]."""
        start = self.joints.copy()
        way = goal - start
        for fraction in self._profile(float(np.abs(way).max()), acceleration, speed):
            self._place(start + way * fraction)
            yield
        self._place(goal)
        yield

    def _place(self, joints: Array) -> None:
        self.pose = self._joints_pose = self.forward(joints)
        self._joints = joints

    def forward(self, joints: Array) -> Array:
        """TCP pose (6,) [m, rad] at joint angles (6,) [rad]."""
        return compose(flange_pose(joints), self.tcp)

    def _profile(self, length: float, acceleration: float, speed: float) -> Iterator[float]:
        """Fractions of `length` travelled after each cycle, the speed slider included."""
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
        """Slow down along the present direction until at rest [m/s^2]."""
        speed = self.speed
        full = self._magnitude(speed)
        left = full
        while left > deceleration * CYCLE:
            left -= deceleration * CYCLE
            self._drift(speed * (left / full))
            yield
        yield

    def run_at(self, goal: Array, acceleration: float) -> None:
        """One cycle of speedl: towards TCP speed `goal` (6,) [m/s, rad/s] at `acceleration`."""
        change = goal - self.speed
        size = self._magnitude(change)
        share = min(1.0, acceleration * CYCLE / size) if size > 0 else 1.0
        self._drift((self.speed + change * share) * self.slider)

    def _drift(self, speed: Array) -> None:
        vector = self.pose[3:]
        if speed[3:].any():
            vector = turn(speed[3:] * CYCLE, vector)
        self.pose = np.concatenate([self.pose[:3] + speed[:3] * CYCLE, vector])

    @staticmethod
    def _magnitude(speed: Array) -> float:
        return max(float(np.linalg.norm(speed[:3])), float(np.linalg.norm(speed[3:])) * _ARM_LENGTH)
