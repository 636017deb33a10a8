"""Messages between the recording process and the process that moves the arm, sent over a pipe.

Each command has a number, and its reply has the same number. A reply to a command that nobody waits
for any more is dropped. `Started` may precede the reply; `Alarm` (number 0) and `Note` are sent
unprompted.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rig.core.guard import Guard, GuardLimits, Kind, Mode
from rig.devices.arm.settings import ArmConfig

# Number of the unprompted reply that reports that the child is ready, or why it is not.
START = 1

Outcome = Literal["done", "force_limited", "stopped", "safety_stop", "device_lost"]


@dataclass(frozen=True, slots=True)
class Setup:
    """Information the child needs at its start."""

    config: ArmConfig
    contact_frame: tuple[float, ...]
    """Pose (6,) of the contact frame in the base frame [m, rad]."""
    limits: GuardLimits
    """Limits of motion."""
    pose_path: Path | None
    """POSE_LATEST record; None: the child's own pose link is used."""
    guards: tuple[tuple[Path, Guard], ...]
    """Shared record of each gauge, or of what stands in for one, and its guard."""


@dataclass(frozen=True, slots=True)
class Move:
    """Move straight to a TCP pose."""

    number: int
    pose: tuple[float, ...]
    """(6,) in the base frame [m, rad]."""
    speed: float
    """[m/s]"""
    acceleration: float
    """[m/s^2]"""
    mode: Mode


@dataclass(frozen=True, slots=True)
class Order:
    """Any other command; the arm stops and comes to rest before each."""

    number: int
    what: Literal["halt", "retract", "close"]
    """`retract`: move away along +z of the contact frame. `close`: end the program on the
    controller, and the child."""


Command = Move | Order


@dataclass(frozen=True, slots=True)
class Started:
    """Report that a movement has begun."""

    number: int
    limit: float
    """Longest time until it has ended, in any way [s]."""


@dataclass(frozen=True, slots=True)
class Reply:
    """Result of a command."""

    number: int
    outcome: Outcome
    start_ns: int
    end_ns: int
    reason: str = ""
    kind: Kind | None = None
    """Kind of the guard's violation, if a violation ended the command."""


@dataclass(frozen=True, slots=True)
class Alarm:
    """Guard's violation while no command was running."""

    kind: Kind
    reason: str
    number: int = 0


@dataclass(frozen=True, slots=True)
class Note:
    """Note for the operator, about nothing that ends a command."""

    text: str


Report = Started | Reply | Alarm | Note
