"""Settings that the devices of all streams have in a bench file."""

from dataclasses import dataclass
from typing import ClassVar, Literal


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamSettings:
    """Uses of the device's stream; by default those of its kind (`recorder.spec.KINDS`)."""

    KIND: ClassVar[str]
    """Name of the device in a bench file."""
    STREAM: ClassVar[str]
    """Kind of the stream."""

    align: Literal["latest", "nearest", "interpolated", "mean", "none"] | None = None
    """Alignment of the stream in `frames`; none leaves it out."""
    roles: tuple[Literal["signal", "label", "guard"], ...] | None = None
    """signal: what the sensor shows; label: what models learn; guard: stops the arm at the bench's
    limits (F/T sensors only)."""

    def check_mock(self) -> None:
        """Reject settings that no emulator can have, on a mock bench."""
