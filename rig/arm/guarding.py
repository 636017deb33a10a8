"""What the arm's process sees: its own pose link, the shared force and pose, the guard."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rig.arm.messages import Setup
from rig.arm.reader import RtdeLink
from rig.arm.rotation import Array, rotation_between
from rig.clock import SECOND_NS, Clock
from rig.errors import DeviceLost
from rig.guard import Guard, Mode, Verdict, judge_safety
from rig.latest import FORCE_LATEST, POSE_LATEST
from rig.shared import LatestRecord

_FRESH = 0.1
"""A pose of our own link older than this: do not talk to ur_rtde, it may hang [s]."""
_STILL, _STILL_TURN = 1e-3, 1e-2
"""At rest [m/s, rad/s]: above the noise of the controller's own speed estimate."""


class SharedValue:
    """The newest record another process publishes, in a file that may appear later.

    Args:
        path: The file; None: never anything.
        dtype: Of its records.
    """

    def __init__(self, path: Path | None, dtype: np.dtype[Any]) -> None:
        self._path = path
        self._dtype = dtype
        self._record: LatestRecord | None = None

    def read(self) -> np.void | None:
        """The newest record, None before the first."""
        if self._record is None:
            if self._path is None or not self._path.exists():
                return None
            self._record = LatestRecord.attach(self._path, self._dtype)
        return self._record.read()


class Watch:
    """Everything the arm's process knows of the world, renewed by `look`.

    Args:
        setup: Limits, contact frame, and where force and pose are shared.
        link: Open pose link.
        clock: Tells the age of records.
    """

    def __init__(self, setup: Setup, link: RtdeLink, clock: Clock) -> None:
        self._host = setup.config.host
        self._settle_ns = round(setup.config.settle * SECOND_NS)
        self._link = link
        self._clock = clock
        self._force = SharedValue(setup.force_path, FORCE_LATEST)
        self._shared_pose = setup.pose_path is not None
        self._pose = SharedValue(setup.pose_path, POSE_LATEST)
        self._guard = Guard(
            setup.limits, setup.contact_frame, watch_force=setup.force_path is not None
        )
        self._sample: dict[str, Any] | None = None
        self._moved_ns = clock.now_ns()
        self.speed_fraction = 1.0
        """Speed slider, 0..1."""
        self.armed = False
        """Whether the streams were needed once: before, their absence is no news."""

    @property
    def pose(self) -> Array | None:
        """TCP pose (6,) in the base frame, of our own link [m, rad]; None before the first."""
        return None if self._sample is None else np.array(self._sample["value"])

    def look(self, mode: Mode) -> Verdict | None:
        """Take in what has arrived and ask the guard.

        Raises:
            DeviceLost: The controller closed the link or is silent.
        """
        for sample in self._link.receive(0.0):
            self._take(sample)
        newest = self._sample
        if newest is not None:
            safety = judge_safety(newest["safety_status"])
            if safety is not None:
                return safety
        pose = self._pose.read() if self._shared_pose else newest
        return self._guard.check(self._clock.now_ns(), self._force.read(), pose, mode)

    def look_again(self, timeout: float) -> Verdict | None:
        """The safety status after waiting up to `timeout` [s] for it to change from normal."""
        deadline_ns = self._clock.now_ns() + round(timeout * SECOND_NS)
        while self._clock.now_ns() < deadline_ns:
            for sample in self._link.receive(0.01):
                self._take(sample)
                verdict = judge_safety(sample["safety_status"])
                if verdict is not None:
                    return verdict
        return None

    def _take(self, sample: dict[str, Any]) -> None:
        self._sample = sample
        self.speed_fraction = float(sample["speed_fraction"])
        speed = sample["speed"]
        if max(map(abs, speed[:3])) > _STILL or max(map(abs, speed[3:])) > _STILL_TURN:
            self._moved_ns = sample["t_ns"]

    def fresh(self) -> bool:
        """Whether the controller has been heard from just now."""
        if self._sample is None:
            return False
        age_ns: int = self._clock.now_ns() - self._sample["t_ns"]
        return age_ns <= round(_FRESH * SECOND_NS)

    def require_fresh(self) -> None:
        """See that it is safe to call ur_rtde.

        Raises:
            DeviceLost: The controller has not been heard from just now.
        """
        if not self.fresh() and not self._heard_after_waiting():
            raise DeviceLost(
                f"arm at {self._host}: silent; is the controller on and its network cable in?"
            )

    def _heard_after_waiting(self) -> bool:
        # Our own process may have been held up: what waits in the socket counts.
        for sample in self._link.receive(_FRESH):
            self._take(sample)
        return self.fresh()

    def still(self) -> bool:
        """Whether the TCP has been at rest for the settling time."""
        return self.fresh() and self._clock.now_ns() - self._moved_ns > self._settle_ns

    def distance(self, goal: Array) -> float:
        """From the TCP to pose (6,) `goal` [m]."""
        pose = self.pose
        return 0.0 if pose is None else float(np.linalg.norm(goal[:3] - pose[:3]))

    def near(self, goal: Array, distance: float, angle: float) -> bool:
        """Whether the TCP is at pose (6,) `goal` within `distance` [m] and `angle` [rad]."""
        pose = self.pose
        if pose is None or self.distance(goal) > distance:
            return False
        return float(np.linalg.norm(rotation_between(pose, goal))) <= angle
