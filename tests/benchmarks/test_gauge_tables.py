"""Rows, scores and jobs of the tables without a gauge; slow: all of them at toy size."""

from __future__ import annotations

import json
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.commands import run_module

from benchmarks.learning.gauge_tables import command, coverage, page
from benchmarks.learning.gauge_tables.jobs import (
    SIZES,
    Study,
    baselines,
    cell,
    from_source,
    names,
    own,
    sums_of,
)
from benchmarks.learning.gauge_tables.skins import GROUPS, planted, require_apart, write_rows
from benchmarks.learning.sums import r_squared_of_sums
from learning.errors import LearningError
from learning.metrics import r_squared
from sim.errors import SceneError
from sim.sensors.quantities import quantities

AXES = 3


@pytest.mark.parametrize("group", GROUPS)
def test_planted_sensors_differ_in_skin_or_mounting(tmp_path: Path, group: str) -> None:
    write_rows(tmp_path, group, GROUPS[group], 0)
    found = [planted(tmp_path, group, design, 0) for design in GROUPS[group]]
    skins = {tuple(quantities(each.row).items()) for each in found}
    assert len(skins) == (1 if group == "homogeneous" else 3)
    assert len({(*each.bench.place, each.bench.height) for each in found}) == 3
    assert len({each.bench.turn for each in found}) == 3
    for each in found:
        assert 0 < max(np.abs(each.bench.place)) < 0.3e-3
        assert 0 < abs(each.bench.height) < 30e-6
    with pytest.raises(SceneError, match=r"skins differ by 0\.0 % and mounts by 0 um"):
        require_apart([found[0].row, found[0].row])


def cells(noise: float, method: str, *, privileged: bool = False) -> list[dict[str, Any]]:
    """Return cells of two seeds and two pairs, whose errors are of some size."""
    found = []
    for seed in range(2):
        for source, target in (("a", "b"), ("b", "a")):
            chance = np.random.default_rng(seed)
            true = chance.normal(size=(800, AXES))
            force = true + noise * chance.normal(size=true.shape)
            indenter = np.repeat(["drawn-0", "drawn-1", "drawn-2", "cone"], 200)
            sums = sums_of(true, force, indenter, true[:, 2] < 1)
            key = {"method": method, "net": "tiny", "spent": 4, "privileged": privileged}
            ends = {"source": source, "target": target, "seed": seed, "sums": sums}
            found.append({**key, **ends, "true": true, "force": force})
    return found


def test_scores_are_those_of_the_frames() -> None:
    these = cells(0.3, "field, simulated")
    (line,) = page.lines_of(these)
    parts = [(each["true"][:600], each["force"][:600]) for each in these]
    assert line.sealed[0] == pytest.approx(np.mean([r_squared(*part).mean() for part in parts]))
    rest = [(each["true"][600:], each["force"][600:]) for each in these]
    assert line.paper[0] == pytest.approx(np.mean([r_squared(*part).mean() for part in rest]))
    inside = [part[0][:, 2] < 1 for part in parts]
    assert line.inside == pytest.approx(
        np.mean([r_squared(t[i], f[i]).mean() for (t, f), i in zip(parts, inside, strict=True)])
    )
    off = np.mean([np.abs(true - force).mean(axis=0) for true, force in parts], axis=0)
    np.testing.assert_allclose(line.mae, [off[:2].mean(), off[2]])
    low, high = page.span(line.sealed)
    assert low < line.sealed[0] < high
    assert (line.pairs, line.seeds, line.spent) == (2, 2, 4)


def test_a_sentence_says_whether_a_named_method_is_within_the_goal() -> None:
    best = cells(0.1, "own labels", privileged=True)
    (told,) = page.verdicts(page.lines_of([*best, *cells(0.15, "field, simulated")]))
    assert told.startswith("field, simulated (tiny): R2 0.97")
    assert told.endswith(": within 0.03.")
    others = [*cells(0.5, "field, simulated"), *cells(0.1, "nearest frame")]
    (told,) = page.verdicts(page.lines_of([*best, *others]))
    assert told.endswith(": not within 0.03.")
    assert page.verdicts(page.lines_of(others)) == []


def test_coverage_counts_each_indenter_alike_and_names_the_worst_sensor(tmp_path: Path) -> None:
    of = study(tmp_path)
    for sensor, known in zip(of.sensors, ((1.0, 0.8), (0.6, 0.8)), strict=True):
        told = {
            **{"learned": coverage.TWIN, "calibrated": coverage.TRUE, "sensor": sensor, "seed": 0},
            **{"scale": 1.0, "width": [0.1, 0.3, 0.5], "error": [0.01, 0.03, 0.05]},
            "indenters": {f"drawn-{k}": [fraction] * 3 for k, fraction in enumerate(known)},
        }
        path = coverage.coverage_path(tmp_path, sensor, 0)
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(told) + "\n", encoding="utf-8")
    (found,) = coverage.read_covered(of, (0, 1))
    assert (found.sensors, found.seeds, found.indenters) == (2, 1, 2)
    assert (found.fraction, found.least) == pytest.approx((0.8, 0.7))
    assert (found.low, found.high) == pytest.approx((0.8, 0.8))
    assert (*found.width, *found.error) == pytest.approx((0.2, 0.5, 0.02, 0.05))


def study(out: Path, seed: int = 0) -> Study:
    """Return the surroundings of jobs at toy size."""
    size = SIZES["toy"]
    return Study(out, size.chain, 0.2, torch.device("cpu"), 1, seed, of=size)


def test_every_job_comes_after_those_it_needs(tmp_path: Path) -> None:
    known: list[str] = []
    for name, needed in names(study(tmp_path), (0, 1)).items():
        assert {*needed} <= {*known}, name
        known.append(name)


def test_an_unknown_job_or_seed_is_refused(tmp_path: Path) -> None:
    words = ("--out", str(tmp_path), "--size", "toy", "--gpus", "cpu")
    with pytest.raises(LearningError, match="--only: found nets; allowed: archive gelsight"):
        run_module(command, *words, "--only", "nets")
    with pytest.raises(LearningError, match="--seeds: found a; allowed"):
        run_module(command, *words, "--seeds", "a")
    with pytest.raises(SceneError, match=r"rows of .*allowed: those of"):
        run_module(command, *words, "--skins", "1")


def blinded(study: Study, target: str) -> None:
    """Take the labels of all located presses of a sensor away."""
    sensor = study.archive[target]
    table = {name: np.array(sensor.table[name]) for name in sensor.table}
    table["wrench"][table["location"] >= 0] = np.nan
    sensor.table = table


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_toy_runs_whole_and_reads_no_label_of_the_target(tmp_path: Path) -> None:
    words = ("--out", str(tmp_path), "--size", "toy", "--gpus", "cpu", "--minutes", "0.2")
    assert run_module(command, *words, "--seeds", "0") == 0
    rows = (tmp_path / "table.csv").read_text(encoding="utf-8").splitlines()
    assert sum(row.startswith('"few-shot') for row in rows) == 4
    assert sum(row.startswith("labels alone") for row in rows) == 4
    told = (tmp_path / "page.md").read_text(encoding="utf-8")
    assert "in simulation" in told.splitlines()[0]
    assert all(f"| {learned} | {by} | 2, 1 |" in told for learned, by in coverage.CASES)
    # It goes on: nothing is left to do.
    assert run_module(command, *words, "--seeds", "0") == 0

    whole, without = study(tmp_path), study(tmp_path)
    source, target = whole.sensors
    stored = {
        (each["method"], each["net"], each["source"], each["target"]): each["sums"]
        for path in (tmp_path / "cells").iterdir()
        for each in map(json.loads, path.read_text(encoding="utf-8").splitlines())
    }
    blinded(without, target)
    pairs = (each for each, _ in baselines(without))
    found = [*takewhile(lambda each: each.target == target, pairs)]
    # Methods that need labels come last, and find none.
    for made in (from_source(without, source), own(without, target)):
        with pytest.raises(LearningError, match="found no label"):
            found.extend(made)
    assert len(found) > 10
    for each in found:
        scored = cell(whole, each, partial=True)
        key = (each.method, each.net, each.source, each.target)
        for name, parts in scored["sums"].items():
            # Labels that were read would be NaN; another number of threads rounds otherwise.
            np.testing.assert_allclose(parts["in"], stored[key][name]["in"], rtol=0.03, atol=0.01)


def test_r_squared_of_sums_is_that_of_the_frames() -> None:
    chance = np.random.default_rng(4)
    true, found = chance.normal(size=(50, 3)), chance.normal(size=(50, 3))
    true[:, 2] = 2.0
    parts = [np.ones_like(true), true, true**2, (found - true) ** 2]
    # Of two parts that are added up.
    sums = [part[:20].sum(axis=0) + part[20:].sum(axis=0) for part in parts]
    np.testing.assert_allclose(r_squared_of_sums(*sums), r_squared(true, found))
