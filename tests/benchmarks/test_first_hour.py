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
    assert first_hour.ran(words, tmp_path, at_bench=True) == (0, "complete")
    assert "$ tactile collect --resume s.zarr\n  complete" in capsys.readouterr().out
    code, last = first_hour.ran(words, tmp_path)
    assert (code, last) == (EXIT_DEVICE_LOST, "to continue: tactile collect --resume s.zarr")
