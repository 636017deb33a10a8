"""The comparison table: measured once, reported in newtons and per cent, and resumed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from support.commands import run_module

from benchmarks.sim.tiers import mpm
from benchmarks.sim.tiers.comparison import (
    BODY_RELEASED,
    FORCE,
    Row,
    choices,
    measure,
    sphere_scene,
)
from sim.mpm import Mpm

ROW = Row(
    name="row",
    force=(0.2652, 0.45985, 3.912),
    reference=FORCE,
    force_rescaled=(0.2652, 0.45985, 3.912),
    up=(0.0, 1e-5, 2e-5, 3e-6),
    outward=(0.0, 4e-5, 5e-5, 6e-6),
    particles=1234,
    steps=567,
    seconds=1.5,
    cpu_seconds=1.25,
    bytes=8_000_000,
    device="cpu",
)


def test_the_table_states_force_and_error_and_the_right_volume_where_it_was_not() -> None:
    lines = mpm.table([ROW, replace(ROW, force_rescaled=(0.5304, 0.9197, 7.824))])
    assert "0.2652  0.4598  3.9120 (   0.0  -50.0  100.0)" in lines[2]
    assert "10.0   20.0    3.0" in lines[2]
    assert "( 100.0    0.0  300.0)  corrected for" in lines[4]
    assert len(lines) == 6


def test_a_row_is_measured_and_not_measured_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[str] = []

    def once(name: str, *_: object, **__: object) -> Row:
        asked.append(name)
        return replace(ROW, name=name)

    monkeypatch.setattr(mpm, "measure", once)
    file = tmp_path / "rows.json"
    for _ in range(2):
        run_module(mpm, "--only", "0.5 mm", "--file", file)
    assert asked == [name for name in choices() if "0.5 mm" in name]
    printed = capsys.readouterr().out
    assert printed.count("cell 0.5 mm") == 2


@pytest.mark.slow
def test_a_measured_row_is_a_press_of_the_shared_sphere() -> None:
    row = measure("coarse", sphere_scene(), Mpm(cell=2e-3))
    assert row.particles == 20 * 20 * 4
    assert 0.3 < row.force[-1] / row.reference[-1] < 1.3
    assert row.force_rescaled == row.force
    assert row.bytes > row.particles * 48


def test_the_authors_presets_are_compared_with_the_force_on_their_own_body() -> None:
    scene, numerics = choices()["authors, as released"]
    assert scene.body == BODY_RELEASED
    assert scene.motion.time[-1] == pytest.approx(1.5e-3 / 40e-3)
    assert numerics == Mpm(published="genforce")
