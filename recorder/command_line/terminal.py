"""Tables, lines and colours of printed text: within a terminal's width, complete elsewhere."""

import os
import re
import shutil
import sys
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Literal, TextIO

State = Literal["good", "note", "warning", "fault", ""]

# In the palette of the terminal, which its user chose for a dark or a light ground.
_STYLES: dict[State, str] = {"good": "32", "note": "33", "warning": "1;33", "fault": "1;31"}
_ESCAPE = re.compile(r"\x1b\[[0-9;]*m")
# Cells that are aligned to the right: numbers, their units, and the sign of a missing one.
_NUMBER = re.compile(r"([-+]?[\d.,/]+(e[-+]\d+)?( \S{1,3})?|nan|-|)$")
# Width below which no column is cut, and the sign for the rest of a cell.
_LEAST, _MORE = 8, "..."


def width_of(stream: TextIO) -> int | None:
    """Return the number of characters in a row of a terminal; None if the stream is none."""
    return shutil.get_terminal_size().columns if stream.isatty() else None


def paint(text: str, state: State, stream: TextIO | None = None) -> str:
    """Return a text in the colour of a state for a terminal, by default standard output.

    It stays as it is elsewhere, with NO_COLOR (no-color.org), and on a terminal without colours.
    """
    dull = os.environ.get("NO_COLOR") or os.environ.get("TERM") in ("dumb", "unknown")
    if not state or dull or not (stream or sys.stdout).isatty():
        return text
    return f"\x1b[{_STYLES[state]}m{text}\x1b[0m"


def line_of(parts: Iterable[str], width: int | None) -> str:
    """Return the parts as one line; the last ones that exceed the width are left out."""
    line, used = "", 0
    for part in filter(None, parts):
        used += len(_ESCAPE.sub("", part)) + 2 * bool(line)
        if width is not None and line and used > width:
            break
        line += f"  {part}" if line else part
    return line


def wrapped(text: str, before: str) -> str:
    """Return a text after `before`; on a terminal it is continued below its own beginning."""
    width = width_of(sys.stdout)
    if width is None:
        return before + text
    indent = len(_ESCAPE.sub("", before))
    lines = textwrap.wrap(
        text, max(width - indent, 20), break_long_words=False, break_on_hyphens=False
    )
    return before + ("\n" + " " * indent).join(lines)


def table(
    columns: Mapping[str, Sequence[object]],
    *,
    spare: Sequence[str] = (),
    states: Sequence[State] = (),
    complete: str = "| less -S",
) -> list[str]:
    """Return columns by heading as lines, with numbers to the right, rows in the colour of a state.

    On a terminal that is too narrow the columns `spare` are left out, the first of them first, then
    the longest ones are cut. The last line says which, and that `complete` shows them.
    """
    cells = {heading: [heading, *map(str, each)] for heading, each in columns.items()}
    widths = {heading: max(map(len, each)) for heading, each in cells.items()}
    width = width_of(sys.stdout)
    hidden = []

    def is_too_wide() -> bool:
        return width is not None and sum(widths.values()) + 2 * len(widths) - 2 > width

    for heading in spare:
        if heading in widths and is_too_wide():
            del widths[heading]
            hidden.append(heading)
    while is_too_wide() and max(widths.values()) > _LEAST:
        longest = max(widths, key=lambda heading: widths[heading])
        widths[longest] -= 1
        hidden += [longest] * (longest not in hidden)
    shown = [_column(heading, cells[heading], wide) for heading, wide in widths.items()]
    lines = ["  ".join(row).rstrip() for row in zip(*shown, strict=True)]
    for number, state in enumerate(states, 1):
        lines[number] = paint(lines[number], state)
    if hidden:
        lines.append(wrapped(f"not shown in full: {', '.join(hidden)} ({complete})", ""))
    return lines


def _column(heading: str, cells: Sequence[str], width: int) -> list[str]:
    """Return cells of one width; of a path the end is kept."""
    kept = width - len(_MORE)
    cut = [
        each
        if len(each) <= width
        else (_MORE + each[-kept:] if heading == "path" else each[:kept] + _MORE)
        for each in cells
    ]
    right = all(map(_NUMBER.match, cells[1:]))
    return [each.rjust(width) if right else each.ljust(width) for each in cut]
