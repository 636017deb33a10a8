"""Lines of tables in Markdown."""

from __future__ import annotations


def head(*cells: str) -> list[str]:
    """Return the two lines that a table begins with."""
    return [line(*cells), "|" + "---|" * len(cells)]


def line(*cells: str) -> str:
    """Return a line of a table."""
    return f"| {' | '.join(cells)} |"
