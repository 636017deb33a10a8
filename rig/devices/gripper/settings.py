"""What the bench file says about the gripper. No vendor library here."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar


@dataclass(frozen=True, slots=True)
class RobotiqConfig:
    """A Robotiq 2F gripper that holds the indenter, on a serial port (USB to RS-485 adapter)."""

    KIND: ClassVar[str] = "robotiq_2f"

    port: str
    """Serial port, best by its `/dev/serial/by-id/` name."""
    slave: int = 9
    """Modbus address."""
    baud: int = 115200
    """Line speed, 8N1 [1/s]."""
    answer: float = field(default=0.1, metadata={"unit": "ms"})
    """One request is answered within this [s]."""
    rate_hz: float = 20.0
    """How often the grip is looked at during a collection."""
    silence: float = field(default=0.5, metadata={"unit": "ms"})
    """Without an answer for so long the grip counts as lost [s]; the gripper itself gives 1 s."""
    position_tolerance: int = 4
    """The fingers may move by so many counts of 255 (about 0.4 mm each on a 2F-85) while they
    hold."""
    speed: int = 50
    """Of a close or open asked for by hand, 0 to 255."""
    force: int = 150
    """The same."""
    object_mock: int = 120
    """Where the emulator's fingers meet the indenter, counts; of no meaning in a lab."""

    def __post_init__(self) -> None:
        """Refuse what no gripper can mean.

        Raises:
            ValueError: Names the field, what was found and what is allowed.
        """
        for name in ("answer", "rate_hz", "silence", "baud"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: {getattr(self, name)!r}; allowed: above 0")
        for name, most in (("slave", 247), ("speed", 255), ("force", 255), ("object_mock", 255)):
            if not 0 <= getattr(self, name) <= most:
                raise ValueError(f"{name}: {getattr(self, name)!r}; allowed: 0 to {most}")
        if self.position_tolerance < 1:
            raise ValueError(
                f"position_tolerance: {self.position_tolerance}; allowed: 1 or more counts"
            )
