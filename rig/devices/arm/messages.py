"""What goes through the pipe between the recording process and the process that moves the arm.

Every command carries a number and is answered by a reply of that number; a reply to a command
nobody waits for any more is dropped. `Started` comes in between, `Alarm` (number 0) unasked.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rig.core.guard import GuardLimits, Kind, Mode
from rig.devices.arm.settings import ArmConfig

# Number of the reply that says the child is ready, or why not: nobody has to ask for it.
START = 1

Outcome = Literal["done", "force_limited", "stopped", "safety_stop", "device_lost"]


@dataclass(frozen=True, slots=True)
class Setup:
    """Everything the child needs from the start."""

    config: ArmConfig
    contact_frame: tuple[float, ...]
    """Pose (6,) of the contact frame in the base frame [m, rad]."""
    limits: GuardLimits
    force_path: Path | None
    """FORCE_LATEST record; None: a bench without F/T sensor."""
    pose_path: Path | None
    """POSE_LATEST record; None: the child's own pose link stands in."""


@dataclass(frozen=True, slots=True)
class Move:
    """Go straight to a TCP pose."""

    number: int
    pose: tuple[float, ...]
    """(6,) in the base frame [m, rad]."""
    speed: float
    """[m/s]"""
    acceleration: float
    """[m/s^2]"""
    mode: Mode


@dataclass(frozen=True, slots=True)
class Halt:
    """Stop and stand still."""

    number: int


@dataclass(frozen=True, slots=True)
class Retract:
    """Stop, then leave along +z of the contact frame."""

    number: int


@dataclass(frozen=True, slots=True)
class Close:
    """End the program on the controller and the child."""

    number: int


Command = Move | Halt | Retract | Close


@dataclass(frozen=True, slots=True)
class Started:
    """A movement has begun."""

    number: int
    limit: float
    """It will have ended, one way or another, after this long [s]."""


@dataclass(frozen=True, slots=True)
class Reply:
    """How a command ended."""

    number: int
    outcome: Outcome
    start_ns: int
    end_ns: int
    reason: str = ""
    kind: Kind | None = None
    """The guard's verdict, where it was one."""


@dataclass(frozen=True, slots=True)
class Alarm:
    """The guard's verdict while no command was running."""

    kind: Kind
    reason: str
    number: int = 0


Report = Started | Reply | Alarm
