"""Planted sensors, scores and the page of the ways without a gauge."""

import argparse
import re
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.gauge import command, coverage, page
from benchmarks.gauge.ladder import (
    BY_TWIN,
    MEAN,
    OWN,
    baselines,
    cell,
    from_source,
    lines_of,
    own,
    prepare,
)
from benchmarks.gauge.planted import GROUPS, planted
from benchmarks.report import Page, Run
from benchmarks.sums import sums_by_indenter
from learning.errors import LearningError
from learning.metrics import r_squared
from sim.sensors.quantities import quantities

AXES = 3


@pytest.mark.parametrize("group", GROUPS)
def test_planted_sensors_differ_in_skin_or_mounting(tmp_path: Path, group: str) -> None:
    sensors = [planted(tmp_path, group, design) for design in GROUPS[group]]
    of_skins = {tuple(quantities(each.row).items()) for each in sensors}
    assert len(of_skins) == (1 if group == "patterns" else 3)
    assert len({(*each.bench.place, each.bench.height) for each in sensors}) == 3
    assert len({each.bench.turn for each in sensors}) == 3
    for each in sensors:
        assert 0 < max(np.abs(each.bench.place)) < 0.3e-3
        assert 0 < abs(each.bench.height) < 30e-6


def cells(noise: float, way: str) -> list[dict[str, Any]]:
    """Return cells of two seeds and two pairs, whose errors are of some size."""
    made = []
    for seed in range(2):
        for source, target in (("a", "b"), ("b", "a")):
            chance = np.random.default_rng(seed)
            true = chance.normal(size=(800, AXES))
            force = true + noise * chance.normal(size=true.shape)
            indenter = np.repeat(["drawn-0", "drawn-1", "drawn-2", "cone"], 200)
            sums = sums_by_indenter(true, force, indenter)
            ends = {"source": source, "target": target, "seed": seed, "sums": sums}
            made.append({"way": way, "net": "tiny", "spent": 4, **ends, "force": (true, force)})
    return made


def test_scores_are_those_of_the_frames_and_drawn_indenters_stand_apart() -> None:
    these = cells(0.3, BY_TWIN)
    (line,) = lines_of(these)
    drawn, papers = (
        [(true[rows], force[rows]) for true, force in (each["force"] for each in these)]
        for rows in (slice(600), slice(600, None))
    )
    for key, parts in (("sealed", drawn), ("paper", papers)):
        assert line[key] == pytest.approx(np.mean([r_squared(*part).mean() for part in parts]))
    errors = np.mean([np.abs(true - force).mean(axis=0) for true, force in drawn], axis=0)
    assert line["mae_shear_n"] == pytest.approx(errors[:2].mean())
    assert line["mae_fz_n"] == pytest.approx(errors[2])
    assert line["sealed_low"] < line["sealed"] < line["sealed_high"]
    assert (line["pairs"], line["spent"]) == (2, 4)


def group(*parts: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the values of a group."""
    lines = lines_of([each for part in parts for each in part])
    return {
        "designs": ["a", "b"],
        "skins": 0,
        "fit": "layer",
        "truth": "fem",
        "lines": lines,
        "twins": {},
    }


def test_a_sentence_says_how_far_the_twins_forces_are_below_own_labels() -> None:
    text = page.summary({"kinds": group(cells(0.1, OWN), cells(0.15, BY_TWIN))})
    assert ", within the aim of 0.03" in text
    text = page.summary({"kinds": group(cells(0.1, OWN), cells(0.5, BY_TWIN))})
    assert ", not within the aim of 0.03" in text
    assert "Below own labels" not in page.summary({"kinds": group(cells(0.5, MEAN))})


@pytest.mark.parametrize(("noise", "words"), [(0.1, "the best way has R2 0.9"), (3.0, "no way")])
def test_a_sentence_says_if_a_way_works_without_a_gauge_press(noise: float, words: str) -> None:
    bare = [each | {"spent": 0} for each in cells(noise, MEAN)]
    text = page.summary({"kinds": group(bare, cells(0.1, OWN))})
    assert f"**With no gauge press on the target**: three kinds of sensors: {words}" in text


def test_each_way_has_its_privilege_and_its_presses(tmp_path: Path) -> None:
    values = group(cells(1.0, MEAN), cells(0.1, OWN))
    rows = [line for line in page.summary({"kinds": values}).splitlines() if line.startswith("| ")]
    assert [row.split(" | ")[0].strip("| ") for row in rows] == ["way", MEAN, OWN]
    assert rows[1].endswith("| 4 | none |")
    assert "a force at each frame" in rows[2]
    text = page.section("kinds", values, Page(tmp_path / "gauge.md"))
    assert f"| {OWN} (`tiny`) | 2 | 4 |" in text
    assert (tmp_path / "images" / "gauge-ladder.png").exists()


def test_a_skin_of_another_modulus_has_the_scaled_forces(tmp_path: Path) -> None:
    scores = {"coverage": 0.9, "r2": 0.8, "width_fz_n": 0.5}
    better = {"coverage": 0.95, "r2": 0.9, "width_fz_n": 0.4}
    rows = [{"modulus": 1.0, "without": scores, "weighed": better, "within": 1.4}]
    text = coverage.section({"skins": rows}, Page(tmp_path / "gauge.md"))
    assert "| without a weight | 90.0 % | 90.0 to 90.0 % | 0.800 (0.800 to 0.800) |" in text


def blinded(ladder: Any, target: str) -> None:
    """Take the labels of all located presses of a sensor away."""
    sensor = ladder.archive[target]
    table = {name: np.array(sensor.table[name]) for name in sensor.table}
    table["wrench"][table["location"] >= 0] = np.nan
    sensor.table = table


def options(*words: str) -> argparse.Namespace:
    """Return the options of a command line."""
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return parser.parse_args(["--quick", *words])


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_quick_run_is_whole_and_reads_no_label_of_the_target(tmp_path: Path) -> None:
    out = tmp_path / "gauge.md"
    words = options("--only", "kinds", "--out", str(out))
    assert command.run(words) == 0
    text = out.read_text(encoding="utf-8")
    assert all(re.search(rf"^\| {way} [(|]", text, re.M) for way in (MEAN, OWN, BY_TWIN))
    # It has no drawn indenter, and concludes nothing.
    assert "what it is given besides" not in text

    def ladder() -> Any:
        return prepare(Run(words, tmp_path, lambda fraction: None), tmp_path, "kinds")

    whole, without = ladder(), ladder()
    source, target = whole.archive
    blinded(without, target)
    # Ways that need labels come last, and find none.
    predictions = [*takewhile(lambda each: each.target == target, baselines(without))]
    predictions += from_source(without, source)
    with pytest.raises(LearningError, match="found no label"):
        predictions.extend(own(without, target))
    seen = {
        (each.way, each.net): each
        for ways in (baselines(whole), from_source(whole, source), own(whole, target))
        for each in ways
        if each.target == target
    }
    assert len(predictions) > 8
    for each in predictions:
        assert cell(whole, each)["sums"]
        # Labels that were read would be NaN; another number of threads rounds otherwise.
        expected = seen[each.way, each.net].force
        np.testing.assert_allclose(each.force, expected, rtol=0.03, atol=0.01)
