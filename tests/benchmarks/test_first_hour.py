"""The script of a user's first hour: its commands exist, and it goes on as a command says."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import first_hour
from recorder.command_line.commands import COMMANDS
from recorder.command_line.errors import EXIT_DEVICE_LOST


def test_every_step_is_a_command_and_the_live_one_is_the_last() -> None:
    steps = list(first_hour.steps())
    for step in steps:
        assert step.words[0] in COMMANDS or " ".join(step.words[:2]) in COMMANDS
    assert [steps[0].words[0], steps[-1].words[0]] == ["init", "live"]


def test_a_lost_device_continues_by_the_command_that_was_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tactile = tmp_path / "tactile"
    tactile.write_text(
        '#!/bin/sh\n[ "$2" = --resume ] && { echo complete; exit 0; }\n'
        f'echo "to continue: tactile collect --resume s.zarr"\nexit {EXIT_DEVICE_LOST}\n'
    )
    tactile.chmod(0o755)
    words = [str(tactile), "collect", "--out", "s.zarr"]
    done = first_hour.ran(words, tmp_path, at_bench=True)
    assert (done.code, done.lines, done.tries) == (0, ["complete"], 2)
    assert "$ tactile collect --resume s.zarr\n  complete" in capsys.readouterr().out
    assert "| `tactile collect --out s.zarr` | 0 | 2 |" in first_hour.page([done])
    once = first_hour.ran(words, tmp_path)
    assert (once.code, once.tries) == (EXIT_DEVICE_LOST, 1)


def test_it_stops_at_the_first_command_that_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bin").mkdir()
    tactile = tmp_path / "bin" / "tactile"
    tactile.write_text('#!/bin/sh\n[ "$1" = init ] && mkdir lab && exit 0\necho broken\nexit 2\n')
    tactile.chmod(0o755)
    words = ["first-hour", "--venv", str(tmp_path), "--out", str(tmp_path / "new")]
    from benchmarks.__main__ import main

    assert main(words) == 2
    text = capsys.readouterr().out
    assert text.endswith("stopped by tactile doctor --sensor gelsight, exit code 2\n")
