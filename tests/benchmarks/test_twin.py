"""Twins in simulation: planted errors, labels and their scores, fits of the sensors' rows."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.commands import run_module

from benchmarks.report import Page
from benchmarks.sums import sums_by_indenter
from benchmarks.twin import command, demo, labels, rows, skins
from benchmarks.twin.planted import Bench, Truth, felt, printed
from benchmarks.twin.rows import fitted, hysteresis, relaxed
from learning.metrics import r_squared
from sim.errors import SceneError
from sim.indenters import NAMES, named
from sim.layer import Layer
from sim.scene import Viscosity
from sim.sensors import SimulatedSensor, TaxelSignal, sensor
from sim.sensors.field import SurfaceField
from sim.sensors.taxels import TaxelPad
from sim.tiers import simulate
from tests.support.few import few


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Page of a quick run of labels."""
    path = tmp_path_factory.mktemp("twin") / "page.md"
    words = ["--quick", "--only", "labels", "--out", str(path)]
    assert run_module(command, *words) == 0
    return path


def results(page: Path, part: str) -> Any:
    return json.loads(page.with_suffix(".json").read_text(encoding="utf-8"))[part]["results"]


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


def test_the_page_says_whether_intervals_contain_the_truth(tmp_path: Path) -> None:
    row = {"number": 0, "errors": {"modulus": 0.02}, "off": {"modulus": 0.5}, "seconds": 9.0}
    other = row | {"errors": {"modulus": 0.04}, "off": {"modulus": -3.0}}
    values = {"tier": "layer", "grid": 64, "presses": [["sphere", [1e-3], 8e-4, 1.6]]}
    values |= {"rows": [row, other], "without": ["skin 2: folds"]}
    text = skins.section("Skins", values, Page(tmp_path / "page.md"))
    assert "| modulus | 3.0 % | 3.8 % | 4.0 % |" in text
    assert "1 of 2 true values lie in their 90 % intervals" in text
    assert "too narrow, by these factors: modulus 1.67" in text
    assert "skin 2: folds" in text


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


# Rows of the sensors.


def fits(sensors: dict[str, SimulatedSensor]) -> list[rows.Line]:
    presses = {name: simulate(rows.prism_press(each), Layer()) for name, each in sensors.items()}
    return rows.fit_forces(sensors, presses)


def with_fit(each: SimulatedSensor, lines: list[rows.Line]) -> SimulatedSensor:
    """Return the sensor with the parameters fitted for it."""
    mine = {line.name: line.found for line in lines if line.name.startswith(each.name)}
    ratios = tuple(value for name, value in mine.items() if "ratio" in name)
    viscosity = each.effects.viscosity
    assert viscosity is not None
    return replace(
        each,
        body=replace(each.body, modulus=1e3 * mine[f"{each.name}: modulus [kPa]"]),
        effects=replace(each.effects, viscosity=Viscosity(ratios, viscosity.times)),
    )


@pytest.mark.slow
def test_a_fitted_row_is_fitted_again_and_keeps_force_and_loss() -> None:
    sensors = {name: sensor(name) for name in rows.FORCES}
    first = fits(sensors)
    sensors = {name: with_fit(each, first) for name, each in sensors.items()}
    assert all(line.agrees for line in fits(sensors))
    peaks = {}
    for name, each in sensors.items():
        result, viscosity = simulate(rows.prism_press(each), Layer()), each.effects.viscosity
        assert viscosity is not None
        depth = -np.array(result.scene.motion.tip)[:, 2]
        cycle = relaxed(depth, -result.force[:, 2], viscosity, speed=each.speed)
        assert hysteresis(*cycle) == pytest.approx(rows.LOSS[name], abs=1e-3)
        peaks[name] = cycle[1].max()
    parts = [peaks[name] / peaks["tacpalm"] for name in rows.FORCES]
    np.testing.assert_allclose(parts, [4, 2, 1], rtol=1e-3)


def test_fitted_gains_give_the_wanted_counts() -> None:
    pad = sensor("uskin")
    assert isinstance(pad.signal, TaxelSignal)
    results = [simulate(rows.prism_shear(pad, point), Layer()) for point in (1, 2)]
    normal, shear = (1e3 * line.found for line in rows.fit_gains(pad, results))
    taxels = TaxelPad(pad.body, replace(pad.signal, gain_normal=normal, gain_shear=shear))
    counts = np.concatenate([taxels.counts(SurfaceField.of(result)) for result in results])
    assert counts[..., 2].max() == pytest.approx(rows.COUNTS_NORMAL, abs=1)
    assert np.abs(counts[..., :2]).max() == pytest.approx(rows.COUNTS_SHEAR, abs=1)


def test_a_row_that_is_off_by_more_than_a_percent_is_named() -> None:
    assert rows.Line("a", 1.0, 1.009).agrees
    assert not rows.Line("a", 1.0, 1.02).agrees


DEPTH = np.linspace(0.0, 1e-3, 9)
FORCE = 4.0 * (DEPTH / 1e-3) ** 1.1


def test_the_loss_is_the_area_between_over_the_area_under() -> None:
    way = np.concatenate([DEPTH, DEPTH[-2::-1]])
    assert hysteresis(way, np.interp(way, DEPTH, FORCE)) == pytest.approx(0.0, abs=1e-12)
    depth = np.array([0.0, 1.0, 2.0, 1.0, 0.0])
    assert hysteresis(depth, np.array([0.0, 2.0, 4.0, 1.0, 0.0])) == pytest.approx(1 / 4)
    with pytest.raises(SceneError, match="down once, then up once"):
        hysteresis(np.array([0.0, 1.0, 0.5, 1.0]), np.ones(4))


def test_a_ramp_of_a_linear_spring_relaxes_as_its_closed_form() -> None:
    """F = k v (t + ratio tau (1 - exp(-t / tau))) on the way down, and 0 once the skin lets go."""
    linear, time, ratio, speed = 4e3, 0.1, 0.3, 5e-3
    branch = Viscosity(ratios=(ratio,), times=(time,))
    depth, force = relaxed(DEPTH, linear * DEPTH, branch, speed=speed)
    half = len(depth) // 2 + 1
    t = depth[:half] / speed
    expected = linear * speed * (t + ratio * time * (1 - np.exp(-t / time)))
    np.testing.assert_allclose(force[:half], expected, rtol=1e-9, atol=1e-9)
    _, force = relaxed(DEPTH, FORCE, Viscosity((1.0,), (0.1,)), speed=speed)
    assert force.min() == 0.0
    assert (force[-5:] == 0).all()
    # A branch that never relaxes only stiffens.
    depth, force = relaxed(DEPTH, FORCE, Viscosity((0.5,), (1e6,)), speed=speed)
    np.testing.assert_allclose(force, 1.5 * np.interp(depth, DEPTH, FORCE), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("fraction", few([0.1, 0.2], 1))
def test_the_fitted_ratio_loses_the_wanted_fraction(fraction: float) -> None:
    branches = fitted(DEPTH, FORCE, (0.05, 0.5), speed=5e-3, fraction=fraction)
    assert branches.ratios[0] == branches.ratios[1]
    lost = hysteresis(*relaxed(DEPTH, FORCE, branches, speed=5e-3))
    assert lost == pytest.approx(fraction, abs=1e-5)
    with pytest.raises(SceneError, match=r"fraction: 0\.99; allowed with times \(0\.05,\) s"):
        fitted(DEPTH, FORCE, (0.05,), speed=5e-3, fraction=0.99)
