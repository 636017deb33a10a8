"""Twins in simulation: planted errors, labels and their scores."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.commands import run_module

from benchmarks.sums import sums_by_indenter
from benchmarks.twin import command, demo, labels
from benchmarks.twin.planted import Bench, Truth, felt, printed
from learning.metrics import r_squared
from sim.indenters import NAMES, named
from sim.sensors import sensor


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Page of a quick run of labels."""
    path = tmp_path_factory.mktemp("twin") / "page.md"
    assert run_module(command, "--quick", "--only", "labels", "--out", str(path)) == 0
    return path


def results(page: Path, part: str) -> Any:
    return json.loads(page.with_suffix(".json").read_text(encoding="utf-8"))[part]["results"]


@pytest.mark.slow
def test_labels_by_twins_are_nearer_to_the_targets_own_than_the_papers(page: Path) -> None:
    (row,) = results(page, "labels")["rows"]
    assert list(row["sums"]) == ["gelsight, tacpalm", "tacpalm, gelsight"]
    for part in row["sums"].values():
        assert {name for sums in part.values() for name in sums} == {"sphere", "torus"}
        means = {method: labels.r2([part], method)[0] for method in labels.METHODS}
        assert means["simulated"] > 0.9
        assert means["simulated"] > max(means["priors"], means["source"])
        assert means["twin"] > means["twin, no gauge"]
    assert (page.parent / "images" / "page-labels.png").stat().st_size > 5000


def test_scores_are_r2_over_all_frames_of_a_draw() -> None:
    random = np.random.default_rng(1)
    true = random.normal(size=(4, 9, 3)) + np.array([0, 1, -4])
    predicted = true + 0.3 * random.normal(size=true.shape)
    names = np.repeat([*"abcd"], 9)
    flat = true.reshape(-1, 3), predicted.reshape(-1, 3)
    part = {"twin": sums_by_indenter(*flat, names)}
    mean, (low, high) = labels.r2([part, part], "twin")
    assert mean == pytest.approx(r_squared(*flat).mean())
    assert low < mean < high < 1


def test_the_demos_last_line_has_the_errors() -> None:
    rows = [
        {"name": name, "truth": 2.0, "twin": 2.1} for name in ("modulus", "thickness", "friction")
    ]
    line = demo.last_line({"rows": rows, "held_out": 0.006})
    assert line == "modulus 5.0 %  thickness 5.0 %  friction 5.0 %  held-out force 0.6 %"


@pytest.mark.parametrize("name", NAMES)
def test_a_larger_print_of_an_indenter_is_wider(name: str) -> None:
    drawn, larger = named(name), printed(named(name), 0.1e-3)
    width = [float(np.diff(each.bounds[0])[0]) for each in (drawn, larger)]
    if np.isfinite(width).all():
        assert width[1] - width[0] == pytest.approx(0.1e-3)
    # Larger bodies of the same form: twice as far away, twice the gap.
    scale = larger.edge_radius / drawn.edge_radius if drawn.edge_radius else width[1] / width[0]
    places = np.random.default_rng(0).uniform(-4e-3, 4e-3, (50, 3))
    gaps = [each.distance(at)[0] for each, at in ((drawn, places), (larger, scale * places))]
    np.testing.assert_allclose(gaps[1], scale * gaps[0], atol=1e-9)


def test_errors_of_a_bench_move_the_tip() -> None:
    skin, ball = sensor("gelsight"), named("sphere_s")
    time = np.linspace(0, 0.2, 11)
    tip = np.column_stack([np.zeros((11, 2)), np.linspace(0.2e-3, -0.8e-3, 11)])

    def last(bench: Bench, at: Any) -> float:
        return float(felt(skin, ball, time, at, bench, Truth(grid=48))[-1, 2])

    exact = last(Bench(), tip)
    assert last(Bench(height=50e-6), tip) == pytest.approx(last(Bench(), tip - [0, 0, 50e-6]))
    aside = replace(Bench(), place=(0.3e-3, 0.0))
    assert last(aside, tip) == pytest.approx(last(Bench(), tip + np.array([0.3e-3, 0, 0])))
    assert exact < last(Bench(compliance=20e-6), tip) < 0
    assert last(Bench(size=0.4e-3), tip) < exact
