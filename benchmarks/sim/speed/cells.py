"""Formatting of numbers in the tables of the page."""

from __future__ import annotations

import math
from collections.abc import Sequence

MISSING = "not measured"


def row(cells: Sequence[str]) -> str:
    """Return a row of a table."""
    return "| " + " | ".join(cells) + " |"


def or_missing(value: float, text: str) -> str:
    """Return `text`, or a placeholder for a value that was not measured."""
    return text if math.isfinite(value) else MISSING


def percent(value: float) -> str:
    """Return a share in percent."""
    return or_missing(value, f"{100 * value:.2f} %")


def memory(size: int) -> str:
    """Return a number of bytes in MiB."""
    return f"{size / 2**20:,.0f} MiB" if size else MISSING


def seconds(value: float) -> str:
    """Return seconds with three digits, or minutes or hours for long times."""
    if not math.isfinite(value):
        return MISSING
    if value < 120:
        return f"{value:.3g} s"
    return f"{value / 60:.1f} min" if value < 7200 else f"{value / 3600:.1f} h"
