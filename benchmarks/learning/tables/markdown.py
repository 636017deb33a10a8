"""Lines of tables in Markdown."""

from __future__ import annotations

import math


def head(*cells: str) -> list[str]:
    """Return the two lines that a table begins with."""
    return [line(*cells), "|" + "---|" * len(cells)]


def or_dash(value: float, form: str) -> str:
    """Return a number in a format; a dash in place of what is none."""
    return f"{value:{form}}" if math.isfinite(value) else "-"


def line(*cells: str) -> str:
    """Return a line of a table."""
    return f"| {' | '.join(cells)} |"
