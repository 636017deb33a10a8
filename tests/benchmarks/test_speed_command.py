"""The command `speed`: its arguments, its errors and its output files."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.commands import run_module

from benchmarks.sim.speed import command
from benchmarks.sim.speed.record import PARTS as RECORDED
from benchmarks.sim.speed.record import read
from sim.errors import SceneError


def run(*words: str) -> int:
    return run_module(command, *words)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--only", "presses,drawing"], "--only: 'presses,drawing'; allowed: some of presses"),
        (["--processes", "0"], "processes: 0; allowed: whole numbers from 1 up"),
        (["--device", "cuda:99", "--processes", "2"], "--processes: 2 on device 'cuda:99'"),
        (["--device", "cuda:99"], "--device: 'cuda:99'; allowed here: cpu"),
        (["--spacing", "-1"], "--spacing: -1.0 mm; allowed: above 0"),
        (["--reference", "nan"], "--reference: nan mm; allowed: above 0"),
        (["--only", "page"], "--out: no measurements in"),
    ],
)
def test_speed_refuses_what_means_nothing(tmp_path: Path, words: list[str], message: str) -> None:
    with pytest.raises(SceneError, match=message):
        run("--out", str(tmp_path), *words)


def test_the_command_offers_every_part_there_is() -> None:
    assert command.PARTS == RECORDED


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_speed_measures_a_little_of_everything_and_writes_a_page(tmp_path: Path) -> None:
    out = tmp_path / "speed"
    assert run("--smoke", "--out", str(out)) == 0
    record = read(out / "cpu.jsonl")
    assert {run.part for run in record.runs.values()} == set(RECORDED)
    assert not any(run.failed for run in record.runs.values())
    before = (out / "cpu.jsonl").read_text()
    assert run("--smoke", "--out", str(out)) == 0
    assert (out / "cpu.jsonl").read_text() == before
    text = (tmp_path / "speed.md").read_text()
    assert text.startswith("# Speed")
    assert "nan" not in text
