"""What the bench file says about pedal and SpaceMouse. No vendor library here."""

from __future__ import annotations

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
    """A USB foot pedal, which is a keyboard with one key to a pedal. Not a safety device."""

    KIND: ClassVar[str] = "hid_pedal"

    device: str
    """`/dev/hidrawN`, or `vendor:product` in hexadecimal as lsusb prints it."""
    mode: Literal["pause", "dead_man"] = "pause"
    """pause: a press toggles a pause before the next target. dead_man: held while the arm presses;
    let go of, the arm halts."""
    key: int = 0
    """HID usage of the key of the pedal that counts; 0: any of them."""
    unplugged_limit: float = field(default=60.0, metadata={"unit": "s"})
    """A pedal that is out counts as let go of, and after so long as lost [s]."""

    def __post_init__(self) -> None:
        """Refuse what no bench can mean.

        Raises:
            ValueError: Names the field, what was found and what is allowed.
        """
        _check_device(self.device)
        if not 0 <= self.key <= 255:
            raise ValueError(f"key: {self.key!r}; allowed: 0 to 255")
        if not self.unplugged_limit > 0:
            raise ValueError(f"unplugged_limit: {self.unplugged_limit!r}; allowed: above 0 s")


@dataclass(frozen=True, slots=True)
class SpaceMouseConfig:
    """A 3Dconnexion SpaceMouse, to jog the arm by hand."""

    KIND: ClassVar[str] = "spacemouse"

    device: str
    """`/dev/hidrawN`, or `vendor:product` in hexadecimal as lsusb prints it."""
    speed_max: float = field(default=0.005, metadata={"unit": "mm_s"})
    """Of the tip at full deflection [m/s]."""
    dead_zone: float = 0.08
    """Deflection below this part of the full one is none."""
    silence: float = field(default=0.2, metadata={"unit": "ms"})
    """Without a report for so long the cap counts as let go of [s]."""

    def __post_init__(self) -> None:
        """Refuse what no bench can mean.

        Raises:
            ValueError: Names the field, what was found and what is allowed.
        """
        _check_device(self.device)
        if not 0 < self.speed_max <= 0.01:
            raise ValueError(
                f"speed_max: {1e3 * self.speed_max:g} mm/s; allowed: above 0, up to 10 mm/s"
            )
        if not 0 <= self.dead_zone < 1:
            raise ValueError(f"dead_zone: {self.dead_zone!r}; allowed: 0 to below 1")
        if not 0 < self.silence <= 1:
            raise ValueError(f"silence: {1e3 * self.silence:g} ms; allowed: above 0, up to 1000 ms")
