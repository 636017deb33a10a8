"""Forces of a finger by balance: pairs of frames, known weights, and the command."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from support.commands import run_module
from support.made_up_squeezes import GRAVITY, holds, planted_signals, squeeze_archives

from learning.errors import LearningError
from learning.force.intervals import AxisError, both, read_intervals
from learning.force.loading import load_force_model
from learning.transfer.scale import forces_at
from learning.transfer.squeezes import squeezes
from learning.transfer.weights import straight, weigh_balanced
from tactile import force

# Exponents by which the signals of ten planted benches are bent; forces at which they are compared.
BENT = (*product((0.8, 1.0, 1.3), repeat=2), (0.9, 1.1))
AT = np.array([0.2, 0.5, 0.8])


@pytest.mark.parametrize("grams", [100, 300])
def test_known_weights_fix_the_curves_of_both_fingers(grams: int) -> None:
    covered, near, narrow, mean = 0, 0, 0, []
    for seed, bent in enumerate(BENT):
        weighed = weigh_balanced(planted_signals(1e-3 * grams, seed, bent))
        off = [
            curve(AT**power) / (12 * AT) - 1
            for curve, power in zip(weighed.curves, bent, strict=True)
        ]
        lines = [weighed.error(finger) for finger in (0, 1)]
        half = np.array([line.base / (12 * AT) + line.slope for line in lines])
        covered += bool((np.abs(off) <= half).all())
        near += bool(np.abs(off).max() <= 0.03)
        narrow += bool(half.max() <= 0.1)
        mean.append(off)
    assert min(covered, narrow) >= 9
    assert near >= 9 or grams < 300
    # Errors of the signals do not shrink the curves, as by least squares they would.
    assert np.abs(np.mean(mean, axis=0)).max() < 0.015


def test_too_few_weights_are_refused() -> None:
    some = planted_signals(0.3, 0, (1.0, 1.0))
    upright = some.only(some.weight > 0)
    with pytest.raises(LearningError, match="found 8 objects, and 0 of 8 steps with"):
        weigh_balanced(upright)
    with pytest.raises(LearningError, match="and 4 of 4 steps"):
        weigh_balanced(some.only(some.step <= 4))
    with pytest.raises(LearningError, match="found 1 objects"):
        weigh_balanced(some.only(some.object == 0))
    # The fingers are swapped, or the turns.
    for fit in (weigh_balanced, straight):
        with pytest.raises(LearningError, match="signals that do not rise with the force"):
            fit(replace(some, weight=-some.weight))


def test_frames_of_both_fingers_pair_by_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    some = holds(2, 3, 0.2)
    some[2] = some[2]._replace(still=False)
    some[3] = some[3]._replace(mass=0.0)
    made = squeeze_archives(tmp_path, some, late_ns=15_000_000)
    for sensor, other, sign in (("right", "left", 1), ("left", "right", -1)):
        pairs = squeezes(made[sensor], made[other])
        # One moves, and one is borne by something else too.
        assert pairs.rows.tolist() == pairs.others.tolist() == [0, 1, *range(4, len(some))]
        load = [sign * 0.2 * GRAVITY * some[row].turn * (some[row].step > 0) for row in pairs.rows]
        assert pairs.weight == pytest.approx(load)
        assert (pairs.step > 0).sum() == 10
    with pytest.raises(LearningError, match="found fingers left, left; allowed: left and right"):
        squeezes(made["left"], made["left"])
    words = ["--sensor", tmp_path / "left.markers.zarr", "--by", "balance"]
    assert run_module(force, *words, "--explain") == 0
    assert "* balance with the other finger of a hand: Fz alone" in capsys.readouterr().out
    with pytest.raises(LearningError, match="--source: missing; allowed: the other finger"):
        run_module(force, *words, "--out", tmp_path / "model")
    late = squeeze_archives(tmp_path / "late", some, late_ns=30_000_000)
    with pytest.raises(LearningError, match="--source: found no frames of dense within 20 ms"):
        squeezes(late["left"], late["right"])


def test_two_independent_errors_add_as_squares() -> None:
    summed = both(AxisError(0.3, 0.0), AxisError(0.4, 0.1))
    assert summed == AxisError(pytest.approx(0.5), pytest.approx(0.1))
    assert both(None, AxisError(0.4, 0.1)) is None


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_command_learns_a_finger_from_the_other_and_from_weights(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("learning.transfer.deliver.export_onnx", lambda model, out: 0.0)
    some = holds(12, 6, 0.1)
    made = squeeze_archives(tmp_path, some)
    left, right = (tmp_path / f"{finger}.markers.zarr" for finger in ("left", "right"))
    other, ways = tmp_path / "other", ["--ways", "ridge,kernel", "--unseen", "object-11"]
    words = ["--sensor", right, "--source", left, *ways, "--out"]
    with pytest.raises(LearningError, match="--source-model: found with labels by own"):
        run_module(force, *words, other, "--by", "own", "--source-model", other)
    assert run_module(force, "--sensor", left, *ways, "--out", other) == 0
    assert run_module(force, *words, tmp_path / "model", "--source-model", other) == 0
    assert run_module(force, *words, tmp_path / "weighed", "--by", "balance") == 0
    assert "by weights: +-" in capsys.readouterr().out
    true = np.array([-one.forces[1] for one in some])
    new = np.array([one.code == 11 for one in some])
    for name in ("model", "weighed"):
        folder = tmp_path / name
        model, intervals = load_force_model(folder), read_intervals(folder)
        assert intervals is not None
        assert model.axes == ("Fz",)
        assert "Fx and Fy are unknown" in (folder / "card.md").read_text()
        predicted = forces_at(made["right"].archived, np.arange(len(some)), model)
        assert np.square(predicted[:, 2] - true)[new].mean() < 0.05 * true.var()
        low, high = intervals.of(predicted)
        assert ((low[:, 2] <= true) & (true <= high[:, 2])).mean() > 0.9
    with pytest.raises(LearningError, match="--source-model: found a model of dense; allowed: one"):
        run_module(force, *words, tmp_path / "x", "--source-model", tmp_path / "model")
