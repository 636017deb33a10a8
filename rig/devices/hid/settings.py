"""Bench file settings of pedal and SpaceMouse. Imports no vendor library."""

import re
from dataclasses import dataclass, field
from typing import ClassVar, Literal

_IDS = re.compile(r"[0-9a-f]{4}:[0-9a-f]{4}")


def _check_device(device: str) -> None:
    if "/" not in device and not _IDS.fullmatch(device):
        raise ValueError(
            f"device: {device!r}; allowed: a path as /dev/hidraw3, or vendor:product as 256f:c635"
        )


@dataclass(frozen=True, slots=True)
class PedalConfig:
    """Settings of a USB foot pedal, a keyboard with one key per pedal. Not a safety device."""

    KIND: ClassVar[str] = "hid_pedal"

    device: str
    """`/dev/hidrawN`, or `vendor:product` in hexadecimal as lsusb prints it."""
    mode: Literal["pause", "dead_man"] = "pause"
    """pause: a press toggles a pause before the next target. dead_man: must be held while the arm
    presses; a release halts the arm."""
    key: int = 0
    """HID usage of the pedal's key; 0: any key."""
    unplugged_limit: float = field(default=60.0, metadata={"unit": "s"})
    """An unplugged pedal counts as released, and after this time as lost [s]."""

    def __post_init__(self) -> None:
        _check_device(self.device)
        if not 0 <= self.key <= 255:
            raise ValueError(f"key: {self.key!r}; allowed: 0 to 255")
        if not self.unplugged_limit > 0:
            raise ValueError(f"unplugged_limit: {self.unplugged_limit!r}; allowed: above 0 s")


@dataclass(frozen=True, slots=True)
class SpaceMouseConfig:
    """Settings of a 3Dconnexion SpaceMouse, to jog the arm by hand."""

    KIND: ClassVar[str] = "spacemouse"

    device: str
    """`/dev/hidrawN`, or `vendor:product` in hexadecimal as lsusb prints it."""
    speed_max: float = field(default=0.005, metadata={"unit": "mm_s"})
    """Speed of the tip at full deflection [m/s]."""
    dead_zone: float = 0.08
    """Fraction of full deflection below which the deflection counts as zero."""
    silence: float = field(default=0.2, metadata={"unit": "ms"})
    """Silence after which the cap counts as released [s]."""

    def __post_init__(self) -> None:
        _check_device(self.device)
        if not 0 < self.speed_max <= 0.01:
            raise ValueError(
                f"speed_max: {1e3 * self.speed_max:g} mm/s; allowed: above 0, up to 10 mm/s"
            )
        if not 0 <= self.dead_zone < 1:
            raise ValueError(f"dead_zone: {self.dead_zone!r}; allowed: 0 to below 1")
        if not 0 < self.silence <= 1:
            raise ValueError(f"silence: {1e3 * self.silence:g} ms; allowed: above 0, up to 1000 ms")
