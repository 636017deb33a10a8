"""Swaps what the gripper holds: lets go, then closes again and again until it holds something."""

from __future__ import annotations

from collections.abc import Callable

from rig.clock import SECOND_NS, Clock
from rig.errors import DeviceLost
from rig.gripper.registers import GripperStatus
from rig.gripper.robotiq import RobotiqDriver

ACTIVATION = 5.0
"""An activation takes one to two seconds [s]."""
_GENTLE = 0
# Slowest and weakest of 0 to 255, while somebody's fingers are near.


def swap_held(
    gripper: RobotiqDriver,
    what: str,
    clock: Clock,
    say: Callable[[str], None],
    *,
    pause: float = 5.0,
    patience: float = 600.0,
    speed: int = _GENTLE,
) -> GripperStatus:
    """Open the fingers and wait until `what` is between them, without a key being pressed.

    Every `pause` seconds the fingers close, slowly and weakly; on nothing they open again. What
    they meet is then held with the configured force.

    Args:
        gripper: Open; activated here if it is not.
        what: What to put there, for the technician.
        clock: For the pauses.
        say: Shows a line.
        pause: Before the fingers open, and before each try to close [s].
        patience: Gives up after this long without anything to hold [s].
        speed: Of the fingers while they look for something, 0 to 255.

    Raises:
        DeviceLost: The gripper is gone or in fault, or nobody came.
    """
    say(f"gripper: opens in {pause:g} s: hold what it holds")
    _rest(clock, pause)
    gripper.activate(ACTIVATION)
    gripper.open_fingers()
    deadline_ns = clock.now_ns() + round(patience * SECOND_NS)
    while clock.now_ns() < deadline_ns:
        say(f"gripper: put {what} between the fingers; they close in {pause:g} s")
        _rest(clock, pause)
        if gripper.move(255, speed=speed, force=_GENTLE).holding:
            status = gripper.close_fingers()
            if status.holding:
                say(f"gripper: {status.text}")
                return status
        gripper.open_fingers()
    raise DeviceLost(f"gripper: nothing to hold in {patience:g} s; {what} was expected")


def _rest(clock: Clock, seconds: float) -> None:
    clock.sleep_until(clock.now_ns() + round(seconds * SECOND_NS))
