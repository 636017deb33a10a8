"""Bench file settings of the arm. Imports no vendor library: a bench is checked without one."""

from dataclasses import dataclass, field
from typing import ClassVar

from rig.core.stream_settings import StreamSettings


@dataclass(frozen=True, slots=True)
class ArmConfig:
    """Settings of one UR e-Series arm: its address, tool and limits of motion."""

    KIND: ClassVar[str] = "ur"
    STREAM: ClassVar[str] = "pose"

    host: str = field(kw_only=True)
    """IP address of the controller (or of its emulator). Ports are fixed by the controller."""
    rate_hz: float = 500.0
    """RTDE pose rate; the controller divides 500 Hz by an integer."""
    tcp: tuple[float, ...] = field(
        default=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), metadata={"pose": True, "plausible": (1.0, 1000.0)}
    )
    """Tool centre point in the flange frame [m, rad] (UR rotation vector)."""
    payload: float = field(default=0.5, metadata={"unit": "kg", "plausible": (0.005, 40)})
    """Mass of everything on the flange [kg]."""
    payload_cog: tuple[float, float, float] = field(
        default=(0.0, 0.0, 0.0), metadata={"unit": "mm", "plausible": (0.5, 1000)}
    )
    """Its centre of gravity in the flange frame [m]."""
    speed: float = field(default=0.005, metadata={"unit": "mm_s", "plausible": (0.05, 250)})
    """Speed near contact [m/s]; if higher, the guard's stopping distance costs too much force."""
    acceleration: float = field(default=0.1, metadata={"unit": "mm_s2", "plausible": (0.5, 5000)})
    """Acceleration near contact [m/s^2]."""
    travel_speed: float = field(default=0.05, metadata={"unit": "mm_s", "plausible": (0.5, 1000)})
    """Speed where no contact is expected, and while retracting [m/s]."""
    travel_acceleration: float = field(
        default=0.5, metadata={"unit": "mm_s2", "plausible": (0.5, 10000)}
    )
    """Acceleration at `travel_speed` [m/s^2]."""
    stop_deceleration: float = field(
        default=2.0, metadata={"unit": "mm_s2", "plausible": (50, 20000)}
    )
    """Deceleration of every halt [m/s^2]."""
    retract: float = field(default=0.02, metadata={"unit": "mm", "plausible": (0.5, 500)})
    """Height of a retract along +z of the contact frame [m]."""
    watchdog_hz: float = 10.0
    """Lowest rate of commands; below it the controller stops its program."""
    settle: float = field(default=0.05, metadata={"unit": "ms", "plausible": (1, 10000)})
    """Time for which the TCP must be at rest before a move counts as done [s]."""

    def __post_init__(self) -> None:
        motions = ("speed", "acceleration", "travel_speed", "travel_acceleration")
        for name in ("rate_hz", *motions, "stop_deceleration", "retract", "watchdog_hz"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: {getattr(self, name)!r}; allowed: above 0")
        if self.payload < 0 or self.settle < 0:
            raise ValueError("payload, settle: allowed: 0 or more")


@dataclass(frozen=True, slots=True)
class ListenedConfig(StreamSettings):
    """Settings of a stream from a UR controller that is only listened to."""

    host: str
    """IP address of the controller; on a mock bench that of the arm."""
    rate_hz: float = 500.0
    """RTDE rate; the controller divides 500 Hz by an integer."""

    def __post_init__(self) -> None:
        if not 0 < self.rate_hz <= 500:
            raise ValueError(f"rate_hz: {self.rate_hz!r}; allowed: above 0, up to 500 Hz")

    @property
    def address(self) -> str:
        """Address of the device, for display."""
        return self.host


@dataclass(frozen=True, slots=True)
class PoseConfig(ListenedConfig):
    """Settings of a further stream of poses."""

    KIND: ClassVar[str] = "ur_pose"
    STREAM: ClassVar[str] = "pose"


@dataclass(frozen=True, slots=True)
class WrenchConfig(ListenedConfig):
    """Settings of the arm's own estimate of the force at its tool: it stops the arm, no more."""

    KIND: ClassVar[str] = "ur_wrench"
    STREAM: ClassVar[str] = "arm_wrench"
