"""Bench file settings of the gripper. Imports no vendor library."""

from dataclasses import dataclass, field
from typing import ClassVar


@dataclass(frozen=True, slots=True)
class RobotiqConfig:
    """Settings of a Robotiq 2F gripper for the indenter, on a serial port (USB to RS-485)."""

    KIND: ClassVar[str] = "robotiq_2f"

    port: str
    """Serial port, preferably by its `/dev/serial/by-id/` name."""
    slave: int = 9
    """Modbus address."""
    baud: int = 115200
    """Line speed, 8N1 [1/s]."""
    answer: float = field(default=0.1, metadata={"unit": "ms"})
    """Time limit for the answer to one request [s]."""
    rate_hz: float = 20.0
    """Rate at which the grip is checked during a collection."""
    silence: float = field(default=0.5, metadata={"unit": "ms"})
    """Silence after which the grip counts as lost [s]; the gripper's own limit is 1 s."""
    position_tolerance: int = 4
    """Largest movement of the fingers while they hold, in counts of 255 (about 0.4 mm each on a
    2F-85)."""
    speed: int = 50
    """Speed of a manual close or open, 0 to 255."""
    force: int = 150
    """Force of a manual close or open, 0 to 255."""
    object_mock: int = 120
    """Position at which the emulator's fingers meet the indenter, counts; unused in a lab."""

    def __post_init__(self) -> None:
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


@dataclass(frozen=True, slots=True)
class HandConfig(RobotiqConfig):
    """Settings of a gripper with a sensor on each finger, whose status is a stream."""

    STREAM: ClassVar[str] = "gripper"

    per_count: float = field(default=0.37e-3, metadata={"unit": "mm", "plausible": (0.001, 1)})
    """Opening per count [m]: 85 mm over 230 counts of a 2F-85."""
    closed: int = 230
    """Position at which the undeformed skins touch, counts."""
    speed: int = 0
    force: int = 0

    def __post_init__(self) -> None:
        super(HandConfig, self).__post_init__()
        if not self.per_count > 0:
            raise ValueError(f"per_count: {self.per_count!r}; allowed: above 0")
        if not 3 < self.closed <= 255:
            raise ValueError(f"closed: {self.closed!r}; allowed: 4 to 255")

    def opening(self, position: float) -> float:
        """Return the distance between the undeformed skins at a position in counts [m]."""
        return (self.closed - position) * self.per_count

    def position(self, opening: float) -> int:
        """Return the position whose opening is nearest to one [m], 0 to 255."""
        return min(max(round(self.closed - opening / self.per_count), 0), 255)

    def nearest(self, opening: float) -> float:
        """Return the opening of whole counts that is nearest to one [m]."""
        return self.opening(self.position(opening))
