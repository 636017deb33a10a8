"""Units that people write, and what they are in SI. The one place where they are converted."""

from __future__ import annotations

import math

SI_PER_UNIT = {
    "mm": 1e-3,
    "mm_s": 1e-3,
    "mm_s2": 1e-3,
    "deg": math.pi / 180,
    "deg_s": math.pi / 180,
    "ms": 1e-3,
    "min": 60.0,
    "kpa": 1e3,
    "n": 1.0,
    "n_mm": 1e-3,
    "n_per_mm": 1e3,
    "hz": 1.0,
    "kg": 1.0,
    "s": 1.0,
}
"""SI value of one of each unit, by the suffix a key in a bench file carries (`speed_mm_s: 5`).

`n_mm` is a torque, newton millimetre; `n_per_mm` a stiffness.
"""


def to_si(value: float, unit: str) -> float:
    """`value` in `unit` as SI."""
    return value * SI_PER_UNIT[unit]


def from_si(value: float, unit: str) -> float:
    """The SI `value` in `unit`."""
    return value / SI_PER_UNIT[unit]
