"""Numbers in words of the page, rows to show, and the devices of a run."""

import math
from collections.abc import Iterable
from typing import Any

Row = dict[str, Any]


def devices_of(device: str) -> list[str]:
    """Return the devices of a run: one CPU core or more, and the GPU if `device` is one."""
    return ["cpu"] if device == "cpu" else [device, "cpu"]


def kind_of(device: str) -> str:
    """Return `CPU` or `GPU`."""
    return "CPU" if device == "cpu" else "GPU"


def chosen(rows: Iterable[Row], kind: str = "", **values: object) -> list[Row]:
    """Return the rows with these values, of `CPU` or `GPU` alone if one is named."""
    return [
        row
        for row in rows
        if kind in ("", kind_of(row["device"]))
        and all(row[name] == value for name, value in values.items())
    ]


def seconds(value: float | None) -> str:
    """Return seconds with two or three digits, in minutes or hours where they are many."""
    if value is None or not math.isfinite(value):
        return "-"
    if value < 0.1:
        return f"{value:.3f} s"
    if value < 120:
        return f"{value:.2f} s" if value < 10 else f"{value:.0f} s"
    return f"{value / 60:.1f} min" if value < 7200 else f"{value / 3600:.1f} h"


def percent(fraction: float | None) -> str:
    """Return a fraction in per cent with two digits, or `-`."""
    if fraction is None or not math.isfinite(fraction):
        return "-"
    value = 100 * fraction
    return f"{value:.2f} %" if value < 1 else f"{value:.1f} %" if value < 10 else f"{value:.0f} %"


def rounded(value: float) -> float | None:
    """Return a number as JSON keeps it: six digits, null without a value."""
    return float(f"{value:.6g}") if math.isfinite(value) else None
