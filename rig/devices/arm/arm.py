"""The arm as seen by the recording process: commands run in a supervised child, which may crash.

An end that leaves the arm usable is returned as a `MoveResult`. Otherwise DeviceLost is raised (the
arm, or data the guard needs, is gone) or SafetyStop (a hard limit, or a controller safety stop).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from rig.core.clock import Clock, SystemClock
from rig.core.errors import DeviceLost, SafetyStop
from rig.core.guard import Guard, GuardLimits, Mode
from rig.devices.arm.messages import Close, Halt, Move, Reply, Retract, Setup
from rig.devices.arm.settings import ArmConfig
from rig.devices.arm.supervisor import Child, HasFileno

logger = logging.getLogger(__name__)

# Within this time the child answers a move or reports how long it will take [s].
_ANSWER = 10.0
# The same for a halt, which may have to wait for a move to end [s].
_STOP_ANSWER = 5.0


@dataclass(frozen=True, slots=True)
class MoveResult:
    """Result of a move that leaves the arm usable."""

    outcome: Literal["done", "force_limited", "stopped"]
    """At the target; ended by the soft force limit; otherwise ended short of the target."""
    start_ns: int
    """Time of the command [ns]."""
    end_ns: int
    """Time at which the arm was at rest [ns]."""
    reason: str = ""
    """Reason for ending short of the target, as text."""


class Arm:
    """Moves one UR e-Series arm under the guard.

    Args:
        config: Address, tool and speeds.
        contact_frame: Pose (6,) of the contact frame in the base frame [m, rad]; +z leaves the
            sensor.
        limits: Limits of motion enforced by the guard.
        pose_path: POSE_LATEST record published by the pose stream; None: the child's own link.
        guards: Shared record of each gauge, or of what stands in for one, and its guard.
        clock: Clock for time limits.
    """

    def __init__(
        self,
        config: ArmConfig,
        contact_frame: ArrayLike,
        limits: GuardLimits,
        *,
        pose_path: Path | None,
        guards: Mapping[Path, Guard],
        clock: Clock | None = None,
    ) -> None:
        self._config = config
        setup = Setup(config, _floats(contact_frame), limits, pose_path, tuple(guards.items()))
        self._child = Child(setup, clock or SystemClock())

    def start(self, timeout: float) -> None:
        """Start the child and wait at most `timeout` [s] until the arm accepts commands."""
        if self._child.alive:
            return
        reply = self._child.start(timeout)
        if reply.outcome != "done":
            self._child.discard(reply.reason)
            _raise_for(reply)

    @property
    def alive(self) -> bool:
        """True while the child runs; False after any crash."""
        return self._child.alive

    def move(
        self,
        pose: ArrayLike,
        *,
        speed: float | None = None,
        acceleration: float | None = None,
        mode: Mode = "guarded",
        on_wait: Callable[[], None] | None = None,
        wake: HasFileno | None = None,
    ) -> MoveResult:
        """Move straight to TCP pose (6,) in the base frame [m, rad] and wait for it to end.

        Args:
            pose: Target.
            speed: [m/s]; default: the configured speed, for travel or near contact by `mode`.
            acceleration: [m/s^2]; default likewise.
            mode: See `rig.core.guard.Guard`.
            on_wait: Called about 20 times a second. An exception it raises (or Ctrl-C) leaves the
                arm moving: call `halt`.
            wake: When it becomes readable, `on_wait` is called at once and must drain it.
        """
        config, target = self._config, _floats(pose)
        slow = mode == "guarded"
        speed = speed or (config.speed if slow else config.travel_speed)
        acceleration = acceleration or (config.acceleration if slow else config.travel_acceleration)
        reply = self._child.ask(
            lambda number: Move(number, target, speed, acceleration, mode), _ANSWER, on_wait, wake
        )
        if reply.outcome == "device_lost" or reply.outcome == "safety_stop":
            _raise_for(reply)
        return MoveResult(reply.outcome, reply.start_ns, reply.end_ns, reply.reason)

    def halt(self) -> None:
        """Stop and wait until the arm is at rest; a `move` in another thread ends as "stopped"."""
        reply = self._child.ask(Halt, _STOP_ANSWER)
        if reply.outcome != "done":
            _raise_for(reply)

    def retract(self) -> bool:
        """Halt, then move away along +z of the contact frame; return False if the arm could not.

        Does not raise when the arm is lost, since it is called while shutting down.
        """
        try:
            reply = self._child.ask(Retract, _STOP_ANSWER)
        except DeviceLost as error:
            logger.warning("no retract: %s", error)
            return False
        if reply.outcome != "done":
            logger.warning("no retract: %s", reply.reason)
        return reply.outcome == "done"

    def recover_and_retract(self, timeout: float = 20.0) -> bool:
        """Start a new child after the last one was lost, and retract first.

        Returns False when the controller does not answer or is in a safety stop, whose cause a
        person must check first.
        """
        try:
            self.start(timeout)
        except (DeviceLost, SafetyStop) as error:
            logger.warning("no recovery: %s", error)
            return False
        return self.retract()

    def check(self) -> None:
        """Raise if the guard found a problem while no command was running."""
        self._child.poll()
        alarm, self._child.alarm = self._child.alarm, None
        if alarm is not None:
            lost = alarm.kind in ("stale_force", "stale_pose")
            raise (DeviceLost if lost else SafetyStop)(alarm.reason)

    def close(self) -> None:
        """Stop the arm in place and end the child; may be called twice."""
        if self._child.alive:
            try:
                self._child.ask(Close, _STOP_ANSWER)
                self._child.join()
            except DeviceLost as error:
                logger.warning("arm not closed in order: %s", error)
        self._child.discard()


def _floats(values: ArrayLike) -> tuple[float, ...]:
    return tuple(np.asarray(values, np.float64).tolist())


def _raise_for(reply: Reply) -> NoReturn:
    if reply.outcome == "device_lost":
        raise DeviceLost(reply.reason)
    raise SafetyStop(reply.reason)
