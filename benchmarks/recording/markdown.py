"""Pieces of Markdown that every section of the page is made of."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import isfinite

from benchmarks.recording.measure import Spread


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table, the first column to the left and the others to the right."""
    lines = [f"| {' | '.join(head)} |", "|---|" + "---:|" * (len(head) - 1)]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)]) + "\n"


def ms(spread: Spread, *, digits: int = 2) -> str:
    """p50, p99 and largest [ms]."""
    return " / ".join(
        f"{1e3 * value:.{digits}f}" for value in (spread.p50, spread.p99, spread.most)
    )


def ratio(first: float, second: float) -> str:
    """How many times `second` is `first`, or a dash where that means nothing."""
    return f"{first / second:.1f}" if second > 0 and isfinite(first) else "-"
