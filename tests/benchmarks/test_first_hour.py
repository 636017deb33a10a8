"""The script of a user's first hour: its commands exist, and it goes on as a command says."""

import itertools
import sys
from dataclasses import asdict
from pathlib import Path

import pytest
from support.chromium import CHROMIUM
from support.collecting import ROOT
from support.lab_page import BENCH, PLAN, TARGETS
from support.sessions import make_session, set_attrs

from benchmarks import first_hour
from benchmarks.__main__ import main
from benchmarks.report import Page
from recorder.command_line.errors import EXIT_DEVICE_LOST
from rig.acquire.collector import target_table
from tactile.commands import COMMANDS
from trajectories import plan_to_json


def test_every_step_is_a_command_and_the_live_one_is_the_last() -> None:
    for clicks, quick in itertools.product((True, False), repeat=2):
        steps = list(first_hour.steps(clicks=clicks, quick=quick))
        for words in steps:
            assert words[0] in COMMANDS or " ".join(words[:2]) in COMMANDS
        assert [steps[0][0], steps[-1][0]] == ["init", "live"]
        assert sum(words[0] == first_hour.PAGE for words in steps) == clicks


def test_a_lost_device_continues_by_the_command_that_was_printed(tmp_path: Path) -> None:
    tactile = tmp_path / "tactile"
    tactile.write_text(
        '#!/bin/sh\n[ "$2" = --resume ] && { echo complete; exit 0; }\n'
        f'echo "to continue: tactile collect --resume s.zarr"\nexit {EXIT_DEVICE_LOST}\n'
    )
    tactile.chmod(0o755)
    words = [str(tactile), "collect", "--out", "s.zarr"]
    done = first_hour.ran(words, tmp_path, at_bench=True)
    assert (done.code, done.lines, done.tries) == (0, ["complete"], 2)
    text = first_hour.section({"commands": [asdict(done)]}, Page(tmp_path / "first-hour.md"))
    assert "| `tactile collect --out s.zarr` | 0 | 2 |" in text
    once = first_hour.ran(words, tmp_path)
    assert (once.code, once.tries) == (EXIT_DEVICE_LOST, 1)


def test_it_stops_at_the_first_command_that_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bin").mkdir()
    tactile = tmp_path / "bin" / "tactile"
    tactile.write_text('#!/bin/sh\n[ "$1" = init ] && mkdir lab && exit 0\necho broken\nexit 2\n')
    tactile.chmod(0o755)
    out = tmp_path / "new" / "first-hour.md"
    assert main(["first-hour", "--venv", str(tmp_path), "--out", str(out)]) == 1
    failed = "FAILED: hour: tactile doctor --sensor gelsight: exit code 2:\nbroken\n"
    assert capsys.readouterr().out.endswith(failed)
    assert "2 commands in" in out.read_text()


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here: apt-get install chromium")
def test_clicks_on_the_page_mark_targets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "sessions").mkdir()
    known = {"plan": plan_to_json(PLAN), "targets_wanted": TARGETS, "sensor": "gelsight"}
    for name in (*first_hour.INDENTERS, "gelsight-setup-home-20261126-002053"):
        path = tmp_path / "sessions" / f"{name}.zarr"
        made = make_session(path, shape=(48, 64), targets=target_table(PLAN, TARGETS, BENCH))
        set_attrs(made, **known, indenter=name if name in first_hour.INDENTERS else "cylinder")
    tactile = tmp_path / "tactile"
    tactile.write_text(f'#!/bin/sh\nPYTHONPATH={ROOT} exec {sys.executable} -m tactile "$@"\n')
    tactile.chmod(0o755)
    words = [str(tactile), "page", "--port", "0"]
    picture = tmp_path / "workbench.png"
    done = first_hour.clicked(words, tmp_path, picture)
    assert done.code == 0, done.lines
    assert done.lines[1] == "sessions: 4 of 4 sessions"
    assert done.lines[2].startswith("replay: ")
    assert done.lines[3:5] == [
        "Marked: 3, 7",
        "at the bench: tactile campaign --file campaigns/again.yaml",
    ]
    assert "again: [3, 7]" in (tmp_path / "campaigns" / "again.yaml").read_text()
    assert picture.read_bytes().startswith(b"\x89PNG")
    # The step fails, with a message, if the page lacks a session.
    (tmp_path / "empty").mkdir()
    monkeypatch.setattr("benchmarks.first_hour.Chromium.patience", 5.0)
    failed = first_hour.clicked(words, tmp_path / "empty", None)
    assert failed.code == 1
    assert any("never true" in line for line in failed.lines)
