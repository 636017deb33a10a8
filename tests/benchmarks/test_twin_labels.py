"""Labels by twins under errors of a bench: the command, its scores, and planted errors."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.commands import run_module

from benchmarks.twin import labels, pads
from benchmarks.twin.planted import Bench, felt, printed
from learning.metrics import r_squared
from sim.errors import SceneError
from sim.indenters import NAMES, named
from sim.sensors import SimulatedSensor, sensor
from sim.sensors.quantities import with_quantities

WORDS = ("--tier", "layer", "--draws", "1", "--grid", "24", "--indenters", "sphere,torus")


def nearly(pad: pads.Pad, error: str) -> SimulatedSensor:
    """Return a twin in place of a fit, which takes longer: the skin, a little thicker."""
    assert error == "none"
    return with_quantities(pad.skin, {"thickness": 1.05 * pad.skin.body.thickness})


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Page of two indenters without errors."""
    out = tmp_path_factory.mktemp("labels") / "page.md"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pads.Pad, "twin", nearly)
        assert run_module(labels, *WORDS, "--errors", "none", "--out", str(out)) == 0
    return out


def rows_of(page: Path) -> list[dict[str, object]]:
    lines = page.with_suffix(".jsonl").read_text(encoding="utf-8").splitlines()
    return [json.loads(line) for line in lines[1:]]


def test_labels_by_twins_are_nearer_to_the_targets_own_than_the_papers(made: Path) -> None:
    sums = rows_of(made)[1]["sums"]
    assert isinstance(sums, dict)
    assert list(sums) == ["gelsight, tacpalm", "tacpalm, gelsight"]
    for part in sums.values():
        assert set(part) == {"sphere", "torus"}
        means = {method: labels.r2([part], method)[0][3] for method in labels.METHODS}
        assert means["simulated"] > 0.9
        assert means["simulated"] > max(means["priors"], means["source"])
        assert means["twin"] > means["twin, no gauge"]


def test_the_command_goes_on_where_it_stopped(made: Path) -> None:
    before, text = rows_of(made), made.read_text(encoding="utf-8")
    assert run_module(labels, *WORDS, "--errors", "none", "--out", str(made)) == 0
    assert rows_of(made) == before
    assert made.read_text(encoding="utf-8") == text
    with pytest.raises(SceneError, match="rows of"):
        run_module(labels, *WORDS, "--seed", "1", "--out", str(made))


@pytest.mark.parametrize("words", [("--errors", "place,wind"), ("--indenters", "bananna")])
def test_unknown_names_are_refused(words: tuple[str, str]) -> None:
    with pytest.raises(SceneError, match=f"{words[0]}: {words[1].split(',')[-1]}; allowed"):
        run_module(labels, *words)


def test_scores_are_r2_over_all_frames_of_a_draw() -> None:
    random = np.random.default_rng(1)
    true = random.normal(size=(4, 9, 3)) + np.array([0, 1, -4])
    told = true + 0.3 * random.normal(size=true.shape)
    part = {
        str(index): {
            "count": 9,
            "sum": one.sum(axis=0).tolist(),
            "square": np.square(one).sum(axis=0).tolist(),
            "missed": {"twin": np.square(other - one).sum(axis=0).tolist()},
        }
        for index, (one, other) in enumerate(zip(true, told, strict=True))
    }
    (*axes, mean), (low, high) = labels.r2([part, part], "twin")
    expected = r_squared(true.reshape(-1, 3), told.reshape(-1, 3))
    np.testing.assert_allclose(axes, expected)
    assert low < mean < high < 1


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

    def last(bench: Bench, at: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> float:
        return float(felt(skin, ball, time, at, bench, grid=48)[-1, 2])

    exact = last(Bench(), tip)
    assert last(Bench(height=50e-6), tip) == pytest.approx(last(Bench(), tip - [0, 0, 50e-6]))
    aside = replace(Bench(), place=(0.3e-3, 0.0))
    assert last(aside, tip) == pytest.approx(last(Bench(), tip + np.array([0.3e-3, 0, 0])))
    assert exact < last(Bench(compliance=20e-6), tip) < 0
    assert last(Bench(size=0.4e-3), tip) < exact
