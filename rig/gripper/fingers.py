"""How the emulated gripper behaves: activation, movement, the object, faults. No I/O.

Faults are methods: what a test or `make faults` injects through the fault port, a test in the same
process may call.
"""

from __future__ import annotations

from rig.clock import SECOND_NS, Clock
from rig.gripper.registers import (
    ACTIVATING,
    ACTIVE,
    AT_POSITION,
    MOVING,
    RESET,
    SILENT_FAULT,
    STOPPED_CLOSING,
    GripperCommand,
    GripperStatus,
)

ACTIVATION = 1.5
"""The first open and close takes this long [s]."""
_SLOWEST, _FASTEST = 60.0, 450.0
"""Counts per second at rSP 0 and 255: 20 and 150 mm/s of a 2F-85."""
_OPEN, _CLOSED = 3, 230
"""Where the fingers come to rest with nothing in between, counts."""
_SILENT_NS = SECOND_NS
_HOLDING_CURRENT, _MOVING_CURRENT = 0.06, 0.2
# Motor current [A].


class Fingers:
    """A 2F gripper as its registers show it.

    Args:
        clock: Moves the fingers.
        object_at: Where closing fingers meet the object, counts; None: there is none.
        holding: Start activated and closed on the object.
    """

    def __init__(self, clock: Clock, *, object_at: int | None, holding: bool = False) -> None:
        self._clock = clock
        self._object_at = object_at
        self._command = GripperCommand(activate=False)
        self._state = RESET
        self._activated_ns = 0
        self._position = float(_OPEN)
        self._moved_ns = self._heard_ns = clock.now_ns()
        self._fault = 0
        if holding:
            if object_at is None:
                raise ValueError("holding: nothing to hold; allowed: with an object")
            self._command = GripperCommand(go=True, position=255, speed=50, force=150)
            self._state, self._position = ACTIVE, float(object_at)

    def obey(self, command: GripperCommand) -> None:
        """Take what was written to the registers."""
        self._advance()
        if not command.activate:
            self._state, self._fault = RESET, 0
        elif not self._command.activate:
            self._state, self._activated_ns = ACTIVATING, self._clock.now_ns()
        elif command.go and self._state != ACTIVE:
            self._fault = 5
        self._command = command

    def heard(self) -> None:
        """Note that the line is alive; after a second of silence the next status tells of it."""
        now_ns = self._clock.now_ns()
        if now_ns - self._heard_ns > _SILENT_NS:
            self._fault = SILENT_FAULT
        self._heard_ns = now_ns

    def status(self) -> GripperStatus:
        """What is read now; the fault of a silence is told once."""
        self._advance()
        command, fault = self._command, self._fault
        if fault == SILENT_FAULT:
            self._fault = 0
        found = self._object()
        current = 0.0
        if self._state == ACTIVE and command.go:
            current = _MOVING_CURRENT if found == MOVING else _HOLDING_CURRENT
        return GripperStatus(
            active=command.activate,
            going=command.go,
            state=self._state,
            object=found,
            fault=fault,
            requested=command.position,
            position=round(self._position),
            current=current,
        )

    def lose_grip(self) -> None:
        """Take the object away: the fingers close further and find nothing."""
        self._advance()
        self._object_at = None

    def slip(self, counts: int) -> None:
        """Let the fingers close by `counts` while they still hold: the object turned or crept."""
        self._advance()
        if self._object_at is not None:
            self._object_at += counts
            self._position = float(self._object_at)

    def insert(self, at: int) -> None:
        """Put an object between open fingers."""
        self._advance()
        self._object_at = at

    def fail(self, fault: int) -> None:
        """Show this fault code until the gripper is reset."""
        self._fault = fault

    def _advance(self) -> None:
        now_ns = self._clock.now_ns()
        elapsed, self._moved_ns = (now_ns - self._moved_ns) / SECOND_NS, now_ns
        if self._state == ACTIVATING and now_ns - self._activated_ns >= ACTIVATION * SECOND_NS:
            self._state, self._position = ACTIVE, float(_OPEN)
        if self._state != ACTIVE or not self._command.go:
            return
        goal = self._goal()
        share = self._command.speed / 255
        step = elapsed * (_SLOWEST + share * (_FASTEST - _SLOWEST))
        if abs(goal - self._position) <= step:
            self._position = goal
        else:
            self._position += step if goal > self._position else -step

    def _goal(self) -> float:
        wanted = float(min(max(self._command.position, _OPEN), _CLOSED))
        if self._object_at is not None and wanted > self._object_at >= self._position:
            return float(self._object_at)
        return wanted

    def _object(self) -> int:
        if self._state != ACTIVE or not self._command.go:
            return AT_POSITION if self._state == RESET else MOVING
        goal = self._goal()
        if self._position != goal:
            return MOVING
        return STOPPED_CLOSING if goal == self._object_at else AT_POSITION
