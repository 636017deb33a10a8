"""Scores, figures and the page of the paper's chain."""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.paper import command, page
from benchmarks.paper.figures import ours
from benchmarks.paper.scores import force_scores
from benchmarks.paper.sizes import SIZES, quick
from benchmarks.report import Page
from benchmarks.sums import r2_of, sums_by_indenter
from learning.metrics import r_squared


def test_intervals_are_of_resampled_indenters() -> None:
    chance = np.random.default_rng(0)
    true = chance.normal(size=(600, 3))
    indenter = np.repeat([f"indenter-{k}" for k in range(6)], 100)
    spread = np.where(indenter == "indenter-0", 1.0, 0.1)[:, None]
    predicted = true + spread * chance.normal(size=true.shape)
    scores = force_scores(true, predicted, indenter, 0)
    assert scores["r2"] == pytest.approx(r_squared(true, predicted).mean(), abs=1e-4)
    assert scores["mae_fz_n"] == pytest.approx(np.abs(predicted - true)[:, 2].mean(), abs=1e-4)
    # One resample in three lacks the bad indenter, some have it twice or more.
    without = indenter != "indenter-0"
    expected = r_squared(true[without], predicted[without]).mean()
    assert scores["r2_high"] == pytest.approx(expected, abs=0.01)
    assert scores["r2_low"] < scores["r2"] - 0.1


def test_r2_of_added_sums_is_that_of_the_frames() -> None:
    chance = np.random.default_rng(4)
    true, predicted = chance.normal(size=(50, 3)), chance.normal(size=(50, 3))
    names = np.repeat(["one", "other"], [20, 30])

    def added() -> Any:
        return r2_of(np.sum([*sums_by_indenter(true, predicted, names).values()], axis=0))

    assert added() == pytest.approx(r_squared(true, predicted).mean())
    true[:, 2] = 2.0
    assert np.isnan(added())
    assert np.isnan(r_squared(true, predicted).mean())


def force(method: str, source: str, target: str, r2: float, fz: float = 0.2) -> dict[str, Any]:
    """Return a row of forces."""
    scores = {"r2": r2, "r2_low": r2 - 0.1, "r2_high": r2 + 0.1}
    errors = {"mae_shear_n": 0.1, "mae_fz_n": fz}
    return {"method": method, "net": "tiny", "source": source, "target": target, **scores, **errors}


def values(*forces: dict[str, Any], held_out: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return the values of a part."""
    return {"forces": [*forces], "held out": [*held_out]}


def test_sensors_that_were_held_out_are_in_no_mean_and_have_a_line_of_their_own(
    tmp_path: Path,
) -> None:
    rows = force("m2m", "r6", "r10", 0.5), force("m2m", "r6", "r14", -9)
    stored = values(*rows, held_out=("r14",))
    line = "| Between skins | - | - | - | - | 0.500 | - |"
    assert line in page.summary({"skins": stored})
    text = page.section("skins", stored, Page(tmp_path / "paper.md"))
    assert "On `r14`, which nothing was trained on: R2 -9.000 by the chain" in text


@pytest.mark.parametrize(
    ("statistic", "value"),
    [("largest", "0.40"), ("smallest", "0.20"), ("mean", "0.30"), ("b:a", "0.40"), ("a:c", "-")],
)
def test_a_value_beside_a_figure_of_the_paper_has_its_statistic(statistic: str, value: str) -> None:
    rows = force("m2m", "a", "b", 0.5), force("m2m", "b", "a", 0.7, 0.4)
    assert ours("m2m", "fz", statistic, [*rows, force("source-only", "a", "b", 0, 9)]) == value


@pytest.mark.parametrize("part", SIZES)
def test_a_quick_run_has_two_sensors_by_tier_layer_and_no_training_time(part: str) -> None:
    size = quick(part)
    assert (len(size.sensors), len(size.sources), set(size.seconds.values())) == (2, 1, {0})
    for plan in size.plans.values():
        assert (plan.work, plan.solving.tier) == ("targets", "layer")


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_quick_run_measures_each_part(tmp_path: Path) -> None:
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    out = tmp_path / "paper.md"
    assert command.run(parser.parse_args(["--quick", "--out", str(out)])) == 0
    text = out.read_text(encoding="utf-8")
    assert all(f"## {title}" in text for title in page.TITLES.values())
    assert "the target was held out" in text
    assert (tmp_path / "images" / "paper-patterns.png").exists()
    (row,) = json.loads(out.with_suffix(".json").read_text())["full-size"]["results"]["rows"]
    assert row["batch"] == 1
    assert row["training"] > 0
    assert row["translation"] > 0
