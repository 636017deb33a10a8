"""The command `frames`: its arguments, its forecast of time and its file."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
from support.commands import run_module

from benchmarks.sim.speed import frames
from benchmarks.sim.speed.frames import Row, forecast, written
from sim.errors import SceneError


def _row(device: str, at_once: int, seconds: float) -> Row:
    frames = 20 * at_once
    return Row("fem", device, 1, at_once, 3000, frames, seconds, frames / seconds, 0, 1, 2)


@pytest.mark.parametrize("counts", ["0", "4097", "1,x", ""])
def test_numbers_of_presses_out_of_range_are_refused(counts: str) -> None:
    with pytest.raises(SceneError, match=r"--counts: .*; allowed: 1 to 4096"):
        run_module(frames, "--counts", counts)


def test_a_cpu_takes_as_long_as_its_processes_have_presses_one_after_the_other() -> None:
    assert forecast(_row("cpu", 1, 2.0), 64, processes=16) == 8.0
    assert forecast(_row("cpu", 64, 8.0), 256, processes=16) == 32.0


def test_a_gpu_is_forecast_only_from_as_many_presses_as_fill_it() -> None:
    assert forecast(None, 64, processes=1) == 0.0
    assert forecast(_row("cuda:0", 1, 2.0), 64, processes=1) == 0.0
    assert forecast(_row("cuda:0", 64, 4.0), 256, processes=1) == 16.0


def test_rows_are_written_with_their_scale_and_errors(tmp_path: Path) -> None:
    path = written([_row("cuda:0", 64, 4.0)], tmp_path / "new", "cuda:0")
    assert path == tmp_path / "new" / "frames-cuda.csv"
    with path.open() as file:
        (row,) = csv.DictReader(file)
    assert row["at_once"] == "64"
    assert float(row["frames_per_second"]) == 320.0
    assert float(row["error_worst_percent"]) == 2.0
