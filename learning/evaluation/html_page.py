"""One HTML page that needs nothing beside it: headings, paragraphs, coloured tables, pictures."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #262a33; max-width: 1180px; margin: 2em auto;
  padding: 0 1em; }
h1 { font-size: 1.6em; }
h2 { font-size: 1.25em; margin-top: 2em; border-bottom: 1px solid #e2e5ea; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13px; }
th, td { padding: 3px 9px; border: 1px solid #e2e5ea; text-align: right; }
th { background: #f7f8fa; font-weight: 600; } td.name, th.name { text-align: left; }
tr.mean td { font-weight: 600; border-bottom: 2px solid #9aa1ad; }
.wide { overflow-x: auto; } img { max-width: 100%; } p.note { color: #646b78; font-size: 13px; }
details { margin: 1em 0; } summary { cursor: pointer; color: #3b6fb6; }
"""


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell of a table."""

    text: str
    """What stands in it."""
    goodness: float | None = None
    """From 0, red, over yellow to 1, green; None leaves it white."""


def number(value: float, digits: int = 2) -> Cell:
    """Return a cell with a number; a dash where there is none."""
    return Cell("-" if math.isnan(value) else f"{value:.{digits}f}")


def graded(value: float, goodness: float, digits: int = 2) -> Cell:
    """Return a cell with a number and a colour; a dash where there is none."""
    if math.isnan(value):
        return Cell("-")
    return Cell(f"{value:.{digits}f}", None if math.isnan(goodness) else goodness)


def page(title: str, parts: Sequence[str]) -> str:
    """Return the page."""
    body = "\n".join(parts)
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head>\n<body>\n"
        f"<h1>{html.escape(title)}</h1>\n{body}\n</body></html>\n"
    )


def heading(text: str) -> str:
    """Return a heading."""
    return f"<h2>{html.escape(text)}</h2>"


def paragraph(text: str) -> str:
    """Return a paragraph."""
    return f"<p>{html.escape(text)}</p>"


def note(text: str) -> str:
    """Return a paragraph in small print."""
    return f'<p class="note">{html.escape(text)}</p>'


def folded(summary: str, content: str) -> str:
    """Return content that is shown when its summary is clicked."""
    return f"<details><summary>{html.escape(summary)}</summary>\n{content}\n</details>"


def picture(png: bytes, said: str) -> str:
    """Return a picture, kept in the page itself."""
    data = base64.b64encode(png).decode()
    return f'<p><img alt="{html.escape(said, quote=True)}" src="data:image/png;base64,{data}"></p>'


def table(
    columns: Sequence[str],
    rows: Sequence[Sequence[Cell | str]],
    *,
    groups: Sequence[tuple[str, int]] = (),
    first_is_mean: bool = False,
) -> str:
    """Return a table.

    Args:
        columns: Names of the columns.
        rows: Cells of each row; a plain text is aligned to the left.
        groups: Headings above the columns: text, and over how many.
        first_is_mean: Whether the first row is the mean of the others, and stands out.
    """
    lines = ['<div class="wide"><table>']
    if groups:
        cells = (f'<th colspan="{count}">{html.escape(text)}</th>' for text, count in groups)
        lines.append(f"<tr>{''.join(cells)}</tr>")
    lines.append("<tr>" + "".join(f"<th>{html.escape(name)}</th>" for name in columns) + "</tr>")
    for place, row in enumerate(rows):
        kind = ' class="mean"' if first_is_mean and place == 0 else ""
        lines.append(f"<tr{kind}>" + "".join(_cell(cell) for cell in row) + "</tr>")
    return "\n".join([*lines, "</table></div>"])


def _cell(cell: Cell | str) -> str:
    if isinstance(cell, str):
        return f'<td class="name">{html.escape(cell)}</td>'
    if cell.goodness is None:
        return f"<td>{html.escape(cell.text)}</td>"
    return f'<td style="background:{_colour(cell.goodness)}">{html.escape(cell.text)}</td>'


def _colour(goodness: float) -> str:
    """Return a pale red, yellow or green, and what lies between."""
    share = min(max(goodness, 0.0), 1.0)
    # Hue 0 is red, 60 yellow, 120 green.
    return f"hsl({120 * share:.0f} 75% 82%)"
