"""Tables of the terminal: cut by column where it is narrow, complete and plain elsewhere."""

import io
import sys

import pytest

from recorder.command_line.terminal import table

COLUMNS = {"n": [1, 20], "note": ["a long reason", "-" * 30], "path": ["sessions/a.zarr"] * 2}


@pytest.mark.parametrize(("width", "spare"), [(60, ()), (40, ()), (30, ("note",))])
def test_a_table_fits_the_terminal_and_says_what_it_leaves_out(
    width: int, spare: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = table(COLUMNS, spare=spare, states=["", "fault"])
    assert whole[2] == f"20  {'-' * 30}  sessions/a.zarr"
    terminal = io.StringIO()
    terminal.isatty = lambda: True  # type: ignore[method-assign]
    monkeypatch.setattr(sys, "stdout", terminal)
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setenv("NO_COLOR", "1")
    lines = table(COLUMNS, spare=spare, states=["", "fault"])
    assert max(map(len, "\n".join(lines).split("\n"))) <= width
    assert lines[1].endswith("a.zarr")
    assert ("not shown in full: note" in lines[-1]) == (width < 60)
    monkeypatch.delenv("NO_COLOR")
    monkeypatch.setenv("TERM", "xterm")
    assert table(COLUMNS, spare=spare, states=["", "fault"])[2].startswith("\x1b[1;31m")
