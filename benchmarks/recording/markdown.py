"""Markdown elements shared by the sections of the page."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import isfinite

from benchmarks.recording.measure import Spread


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table with the first column left-aligned and the others right-aligned."""
    lines = [f"| {' | '.join(head)} |", "|---|" + "---:|" * (len(head) - 1)]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)]) + "\n"


def ms(spread: Spread, *, digits: int = 2) -> str:
    """Return p50, p99 and maximum [ms]."""
    return " / ".join(
        f"{1e3 * value:.{digits}f}" for value in (spread.p50, spread.p99, spread.most)
    )


def ratio(first: float, second: float) -> str:
    """Return `first` divided by `second`, or a dash if that is undefined."""
    return f"{first / second:.1f}" if second > 0 and isfinite(first) else "-"
