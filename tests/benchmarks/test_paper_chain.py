"""Scores and jobs of the paper's chain."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pytest

from benchmarks.learning.paper_chain import command
from benchmarks.learning.paper_chain.card import card
from benchmarks.learning.paper_chain.jobs import force_scores, names
from benchmarks.learning.paper_chain.page import last_line, write
from benchmarks.learning.paper_chain.sizes import ALL, SIZES
from learning.errors import LearningError
from learning.metrics import r_squared


def test_intervals_are_of_resampled_indenters() -> None:
    chance = np.random.default_rng(0)
    true = chance.normal(size=(600, 3))
    indenter = np.repeat(np.arange(6), 100)
    spread = np.where(indenter == 0, 1.0, 0.1)[:, None]
    found = true + spread * chance.normal(size=true.shape)
    scores = force_scores(true, found, indenter)
    assert scores["r2"] == pytest.approx(r_squared(true, found).mean(), abs=1e-4)
    assert scores["mae_fz_n"] == pytest.approx(np.abs(found - true)[:, 2].mean(), abs=1e-4)
    # One resample in three lacks the bad indenter, some have it twice or more.
    without = indenter > 0
    assert scores["r2_high"] == pytest.approx(
        r_squared(true[without], found[without]).mean(), abs=0.01
    )
    assert scores["r2_low"] < scores["r2"] - 0.1
    alike = force_scores(true, true + 0.1, indenter)
    assert alike["mae_fz_low_n"] == alike["mae_fz_high_n"] == 0.1


def test_every_job_comes_after_those_it_needs() -> None:
    for size in SIZES.values():
        known = ["archive patterns", *(f"archive {name}" for name in size.archives)]
        for name, needed in names(size).items():
            assert {*needed} <= {*known}, name
            known.append(name)


def test_the_card_of_a_net_has_its_data_split_seed_and_errors() -> None:
    row = {"target": "gelsight", "net": "displacement", "seed": "0", "frames": "36"}
    row |= {"r2": "0.98", "r2_low": "0.97", "r2_high": "0.99"}
    row |= {f"r2_f{axis}": value for axis, value in zip("xyz", ("0.8", "0.7", "0.6"), strict=True)}
    for axis in ("shear", "fz"):
        row |= {f"mae_{axis}{end}_n": f"0.{len(axis)}" for end in ("", "_low", "_high")}
    text = card(
        row,
        millions=0.677,
        archive="--sensors gelsight",
        frames=54,
        trained=["prism"],
        tested=["wave", "torus"],
        seconds=9.5,
    )
    first = text.splitlines()[2]
    assert first.startswith(
        "Fx, Fy, Fz of the simulated sensor `gelsight` from marker displacement"
    )
    for part in (
        "0.68 M weights",
        "54 frames",
        "trained on prism; tested on wave, torus",
        "Seed 0",
        "R2 0.98 (0.97 to 0.99) (Fx 0.8, Fy 0.7, Fz 0.6)",
        "of Fz 0.2 N (0.2 to 0.2)",
        "Apache-2.0",
    ):
        assert part in text, part


def test_all_sizes_run_in_turn_until_one_is_not_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[argparse.Namespace] = []

    def run(options: argparse.Namespace) -> int:
        begun.append(options)
        return int(len(begun) == 3)

    monkeypatch.setattr(command, "run", run)
    given = argparse.Namespace(size="all", out=tmp_path, stop_after=100, job=None, only=None)
    assert command.run_all(given) == 1
    assert [one.out for one in begun] == [tmp_path / size for size in ALL[:3]]
    assert [one.size for one in begun] == [*ALL[:3]]
    assert all(0 < one.stop_after <= 100 for one in begun)
    given.job = "vae"
    with pytest.raises(LearningError, match="--job"):
        command.run_all(given)


def test_tables_are_of_the_rows_that_there_are(tmp_path: Path) -> None:
    write(tmp_path, SIZES["toy"])
    assert (
        last_line(tmp_path, SIZES["toy"])
        == "paper chain R2 -  nearest frame R2 -  displacement R2 -"
    )
    head = "method,net,source,target,r2,r2_low,r2_high,mae_shear_n,mae_fz_n\n"
    rows = "m2m,tiny,a,b,0.5,0.4,0.6,0.1,0.2\nm2m,tiny,b,a,0.7,0.6,0.8,0.1,0.4\n"
    (tmp_path / "forces.csv").write_text(head + rows)
    write(tmp_path, SIZES["toy"])
    line = "| m2m | tiny | 2 | 0.600 | 0.500 to 0.700 | 0.500 (a to b) | 0.100, 0.300 | - |"
    assert line in (tmp_path / "tables.md").read_text()
    assert (tmp_path / "forces.png").exists()
    assert last_line(tmp_path, SIZES["toy"]).startswith("paper chain R2 0.600  nearest")


def test_held_out_sensors_are_not_in_the_last_line(tmp_path: Path) -> None:
    head = "method,net,source,target,r2\n"
    rows = "m2m,tiny,r6,r10,0.5\nm2m,tiny,r6,r14,-9\n"
    (tmp_path / "forces.csv").write_text(head + rows)
    assert last_line(tmp_path, SIZES["material"]).startswith("paper chain R2 0.500  nearest")
