"""What a Robotiq 2F gripper's registers mean. Pure, no I/O.

    write from 0x03E8   rACT b0, rGTO b3 (high byte of the first) | rPR | rSP << 8 | rFR
    read  from 0x07D0   gACT b0, gGTO b3, gSTA b4-5, gOBJ b6-7 (high byte) | gFLT << 8 | gPR
                        | gPO << 8 | gCU

Positions are counts: 0 open, 255 closed, about 0.4 mm each on a 2F-85. Source: Robotiq 2F-85 and
2F-140 instruction manual, chapter Control.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

COMMAND_ADDRESS, STATUS_ADDRESS, REGISTERS = 0x03E8, 0x07D0, 3
"""First register to write, first to read, and how many of each."""

RESET, ACTIVATING, ACTIVE = 0, 1, 3
"""gSTA."""
MOVING, STOPPED_OPENING, STOPPED_CLOSING, AT_POSITION = 0, 1, 2, 3
"""gOBJ: under way; stopped by an object while opening, while closing; no object in between."""

CURRENT_PER_COUNT = 0.01
"""Motor current of one count of gCU [A]."""

SILENT_FAULT = 9
"""gFLT after a second without communication."""
FAULTS = {
    5: "action delayed, the activation must be completed first",
    7: "the activation bit must be set first",
    8: "too hot",
    SILENT_FAULT: "no communication for a second",
    10: "supply voltage too low",
    11: "automatic release in progress",
    12: "internal fault",
    13: "activation fault",
    14: "overcurrent",
    15: "automatic release completed",
}
"""What gFLT says, for people."""


@dataclass(frozen=True, slots=True)
class GripperCommand:
    """What the gripper is told: activate, and go to a position."""

    activate: bool = True
    """rACT; False resets it."""
    go: bool = False
    """rGTO: move to the position; False: stand still."""
    position: int = 0
    """rPR: 0 open to 255 closed."""
    speed: int = 0
    """rSP: 0 slowest to 255."""
    force: int = 0
    """rFR: 0 weakest to 255."""

    def __post_init__(self) -> None:
        """Refuse what one byte cannot hold.

        Raises:
            ValueError: Names it, what was found and what is allowed.
        """
        for name in ("position", "speed", "force"):
            value = getattr(self, name)
            if not 0 <= value <= 255:
                raise ValueError(f"{name}: found {value!r}; allowed: 0 to 255")


@dataclass(frozen=True, slots=True)
class GripperStatus:
    """What the gripper says of itself."""

    active: bool
    """gACT: whether it was told to activate."""
    going: bool
    """gGTO: whether it was told to move."""
    state: int
    """gSTA: RESET, ACTIVATING or ACTIVE."""
    object: int
    """gOBJ: MOVING, STOPPED_OPENING, STOPPED_CLOSING or AT_POSITION."""
    fault: int
    """gFLT: 0 none."""
    requested: int
    """gPR: the position it was told, counts."""
    position: int
    """gPO: where it is, counts."""
    current: float
    """Of the motor [A]."""

    @property
    def holding(self) -> bool:
        """Whether the fingers rest on an object, inside or outside of it."""
        return self.state == ACTIVE and self.object in (STOPPED_OPENING, STOPPED_CLOSING)

    @property
    def text(self) -> str:
        """The status for people."""
        state = {RESET: "reset", ACTIVATING: "activating", ACTIVE: "active"}
        found = ("moving", "holds from inside", "holds", "no object")[self.object]
        fault = f", fault {self.fault}: {fault_text(self.fault)}" if self.fault else ""
        return (
            f"{state.get(self.state, 'state 2')}, {found}, position {self.position} of 255"
            f" ({self.current:.2f} A){fault}"
        )


def fault_text(fault: int) -> str:
    """What gFLT says, for people."""
    return FAULTS.get(fault, "unknown to the manual")


def emit_command(command: GripperCommand) -> tuple[int, int, int]:
    """The registers to write from COMMAND_ADDRESS."""
    action = (command.activate << 0) | (command.go << 3)
    return (action << 8, command.position, command.speed << 8 | command.force)


def parse_command(registers: Sequence[int]) -> GripperCommand:
    """What was told with three registers: the inverse of `emit_command`."""
    action, position, drive = registers
    return GripperCommand(
        activate=bool(action & 0x100),
        go=bool(action & 0x800),
        position=position & 0xFF,
        speed=drive >> 8,
        force=drive & 0xFF,
    )


def emit_status(status: GripperStatus) -> tuple[int, int, int]:
    """The registers to read from STATUS_ADDRESS."""
    byte = status.active | status.going << 3 | status.state << 4 | status.object << 6
    current = min(round(status.current / CURRENT_PER_COUNT), 255)
    return (
        byte << 8,
        status.fault << 8 | status.requested,
        status.position << 8 | current,
    )


def parse_status(registers: Sequence[int]) -> GripperStatus:
    """What the gripper says with three registers: the inverse of `emit_status`."""
    first, second, third = registers
    byte = first >> 8
    return GripperStatus(
        active=bool(byte & 1),
        going=bool(byte & 8),
        state=byte >> 4 & 3,
        object=byte >> 6 & 3,
        # The high half of the byte holds kFLT, of an optional controller.
        fault=second >> 8 & 0xF,
        requested=second & 0xFF,
        position=third >> 8,
        current=(third & 0xFF) * CURRENT_PER_COUNT,
    )
