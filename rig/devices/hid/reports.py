"""Formats of HID reports. Pure, no I/O.

    pedal        modifiers u8 | reserved u8 | six keys u8   the boot keyboard report of HID 1.11,
                 appendix B.1; a device with several reports prepends the report's number
    SpaceMouse   1 | x y z i16    2 | rx ry rz i16    3 | buttons u16..., little endian;
                 wireless models send 1 | x y z rx ry rz

The SpaceMouse's full scale of 350, and its axes (x right, y towards the user, z down), are those of
pyspacemouse's table of devices.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

# Counts of a SpaceMouse axis at full deflection.
FULL_SCALE = 350

_KEYBOARD = 8
# Usages 1 to 3 of the keyboard page are errors: too many keys, self-test, undefined.
_FIRST_KEY = 4
_MODIFIER_USAGE = 0xE0

Axes = tuple[float, float, float]


def parse_keys(report: bytes) -> frozenset[int]:
    """Return the HID usages of the keys held down, modifiers as 0xE0 to 0xE7."""
    if len(report) == _KEYBOARD + 1:
        report = report[1:]
    if len(report) != _KEYBOARD:
        raise ValueError(f"{len(report)} bytes; a keyboard report has {_KEYBOARD}")
    if report[1]:
        # Reserved. Checked because garbage of the right length would hold keys down.
        raise ValueError(f"not a keyboard report: its second byte is 0x{report[1]:02x}")
    keys = {key for key in report[2:] if key}
    if keys and min(keys) < _FIRST_KEY:
        raise ValueError(f"keyboard error {min(keys)}")
    return frozenset(keys | {_MODIFIER_USAGE + bit for bit in range(8) if report[0] >> bit & 1})


def emit_keys(keys: Sequence[int]) -> bytes:
    """Return the boot keyboard report that holds up to six `keys` down, and any modifiers."""
    plain = [key for key in keys if key < _MODIFIER_USAGE]
    if len(plain) > 6:
        raise ValueError(f"keys: found {len(plain)}; allowed: up to 6")
    modifiers = sum(1 << key - _MODIFIER_USAGE for key in keys if key >= _MODIFIER_USAGE)
    return bytes([modifiers, 0, *plain]).ljust(_KEYBOARD, b"\0")


@dataclass(frozen=True, slots=True)
class CapReport:
    """Content of one SpaceMouse report; None: not in this report."""

    shift: Axes | None = None
    """x right, y away from the user, z up; 1 is full deflection."""
    turn: Axes | None = None
    """Rotation about these axes, right-handed."""
    buttons: frozenset[int] | None = None
    """Numbers of the buttons held down, from 0."""


def parse_cap(report: bytes) -> CapReport:
    """Parse a SpaceMouse's report."""
    if len(report) >= 13 and report[0] == 1:
        return CapReport(shift=_axes(report, 1), turn=_axes(report, 7))
    if len(report) >= 7 and report[0] == 1:
        return CapReport(shift=_axes(report, 1))
    if len(report) >= 7 and report[0] == 2:
        return CapReport(turn=_axes(report, 1))
    if len(report) >= 2 and report[0] == 3:
        held = int.from_bytes(report[1:], "little")
        return CapReport(buttons=frozenset(k for k in range(held.bit_length()) if held >> k & 1))
    raise ValueError(f"report {report[:1].hex() or 'empty'} of {len(report)} bytes is unknown")


def emit_cap(report: CapReport) -> bytes:
    """Return the report of one field, or of shift and turn together as in wireless models."""
    shift, turn, buttons = report.shift, report.turn, report.buttons
    if buttons is not None and shift is None and turn is None:
        return b"\x03" + sum(1 << k for k in buttons).to_bytes(2, "little")
    if buttons is None and shift is not None:
        return b"\x01" + _counts(shift) + (b"" if turn is None else _counts(turn))
    if buttons is None and turn is not None:
        return b"\x02" + _counts(turn)
    raise ValueError(f"{report}: allowed: shift, turn, shift and turn, or buttons")


def _axes(report: bytes, at: int) -> Axes:
    x, y, z = struct.unpack_from("<3h", report, at)
    return (_part(x), _part(-y), _part(-z))


def _part(count: int) -> float:
    return max(-1.0, min(1.0, count / FULL_SCALE))


def _counts(axes: Axes) -> bytes:
    x, y, z = (round(FULL_SCALE * value) for value in axes)
    return struct.pack("<3h", x, -y, -z)
