"""Looks at the grip while the arm works, in a thread of its own."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any

from rig.core.clock import SECOND_NS, Clock, Pacer
from rig.core.errors import DeviceLost
from rig.devices.gripper.robotiq import RobotiqDriver
from rig.devices.gripper.robotiq_wire import ACTIVE, AT_POSITION, GripperStatus, fault_text
from rig.devices.gripper.settings import RobotiqConfig

logger = logging.getLogger(__name__)


def judge(status: GripperStatus, reference: GripperStatus, tolerance: int) -> str | None:
    """Why the grip is lost, or None while it holds.

    Args:
        status: Now.
        reference: When it was known to hold.
        tolerance: The fingers may have moved by so many counts of 255.
    """
    if status.fault:
        return f"fault {status.fault}: {fault_text(status.fault)}"
    if status.state != ACTIVE:
        return "it is not active any more"
    if status.object == AT_POSITION:
        return f"the object is gone (gOBJ 3, fingers at {status.position} of 255)"
    if not status.holding:
        return f"the fingers move (gOBJ 0, at {status.position} of 255)"
    moved = status.position - reference.position
    if abs(moved) > tolerance:
        return (
            f"the fingers moved by {moved:+d} counts of 255 (from {reference.position} to "
            f"{status.position}); allowed: {tolerance}"
        )
    return None


class GripWatch:
    """Polls one gripper and remembers the first reason why its grip is lost.

    Args:
        config: The gripper.
        clock: Paces, and tells silence.
        on_lost: Called once, from the watching thread.
    """

    def __init__(self, config: RobotiqConfig, clock: Clock, on_lost: Callable[[], None]) -> None:
        self._config = config
        self._clock = clock
        self._on_lost = on_lost
        self._driver = RobotiqDriver(config, clock)
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        self.lost: str | None = None
        """Why the grip is lost, for people; None while it holds."""
        self.polls = 0
        """Answers so far."""

    def open(self, timeout: float) -> dict[str, Any]:
        """Reach the gripper, see that it holds something, and start to watch; its facts.

        Raises:
            DeviceLost: Nobody answers, or it holds nothing.
        """
        self._driver.open(timeout)
        status = self._driver.status()
        why = judge(status, status, self._config.position_tolerance)
        if why is not None:
            raise DeviceLost(
                f"gripper at {self._config.port}: does not hold the indenter: {why} "
                f"({status.text}); put it between the fingers, then run: make grip"
            )
        facts = self._driver.describe()
        logger.info("preflight  gripper %s", status.text)
        self._thread = threading.Thread(target=self._run, args=(status,), name="grip")
        self._thread.start()
        return facts

    def close(self) -> None:
        """Stop watching; the gripper keeps holding. Safe twice."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._driver.close()

    def _run(self, reference: GripperStatus) -> None:
        pacer = Pacer(self._clock, self._config.rate_hz)
        heard_ns = self._clock.now_ns()
        while not self._ending.is_set() and self.lost is None:
            pacer.wait()
            try:
                status = self._driver.status()
            except DeviceLost as error:
                # One spoilt answer is none yet: the line is shared with motors and their noise.
                silent = (self._clock.now_ns() - heard_ns) / SECOND_NS
                if silent > self._config.silence:
                    self._lose(f"no good answer for {silent:.1f} s: {error}")
                continue
            heard_ns = self._clock.now_ns()
            self.polls += 1
            why = judge(status, reference, self._config.position_tolerance)
            if why is not None:
                self._lose(why)

    def _lose(self, why: str) -> None:
        self.lost = f"gripper: grip lost: {why}"
        self._on_lost()
