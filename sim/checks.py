"""Checks of a value's fields, said the same way everywhere."""

from __future__ import annotations

import math

from sim.errors import SceneError


def check_range(
    owner: str,
    name: str,
    value: float,
    low: float,
    high: float,
    *,
    unit: str = "",
    open_low: bool = False,
) -> None:
    """Refuse a number that is not finite or not within `low` to `high`.

    Raises:
        SceneError: Names the field, what was found and what is allowed.
    """
    number = isinstance(value, int | float) and not isinstance(value, bool)
    inside = number and math.isfinite(value) and low <= value <= high
    if not inside or (open_low and value == low):
        unit = f" {unit}" if unit else ""
        edge = "above " if open_low else ""
        raise SceneError(
            f"{owner}.{name}: {value!r}{unit}; allowed: {edge}{low:g} to {high:g}{unit}"
        )
