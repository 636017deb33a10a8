"""Forces on a sensor without a gauge: its labels are never read, and intervals keep their word."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.commands import run_module
from support.made_up_archives import made_up_archive, write_twin

from learning.cli import calibrate_force, evaluate, predict
from learning.data.labels import Labels, read_labels
from learning.data.matching import SensorSelection, Tolerances
from learning.errors import LearningError
from learning.evaluation.predictions import read_predictions
from learning.force.intervals import (
    AxisError,
    Intervals,
    LearnedShapes,
    Scale,
    ScaleSample,
    beyond_largest,
    fit_errors,
    measured_scale,
    read_intervals,
)
from learning.transfer.pairs import join_pair, labels_by_place
from learning.transfer.scale import forces_of_holds, gains_of_labels
from learning.transfer.score import NewFrames, score_of
from recorder import MarkerArchive
from recorder.spec import PHASES
from tactile import force
from tests.support.few import few

ASSUMED = Scale(2.0, "assumed", assumed=True)
KNOWN = Scale(1.0, "known", assumed=False)
# Shapes up to a distance of 4 are inside.
LEARNED = LearnedShapes(tuple(map(tuple, np.eye(7).tolist())), ((0.0,) * 7,), 4.0)
INTERVALS = Intervals(
    axes=(AxisError(0.1, 0.0), None, AxisError(0.2, 0.1)),
    scale=KNOWN,
    largest=(1.0, None, 10.0),
    learned=LEARNED,
    frames=100,
    indenters=("cone",),
    errors_from="made up",
)


def shapes(*distances: float) -> np.ndarray:
    """Return shapes at some distances from the mean."""
    return np.outer(distances, np.eye(7)[0])


def test_ninety_percent_of_new_errors_are_within_intervals_fitted_to_old_ones() -> None:
    random = np.random.default_rng(3)

    def frames(count: int) -> tuple[np.ndarray, np.ndarray]:
        true = np.stack([random.normal(size=count), random.normal(size=count)] * 2, 1)[:, :3]
        true[:, 2] = -random.uniform(0, 10, count)
        size = 0.05 + 0.08 * np.linalg.norm(true, axis=1, keepdims=True)
        return true, true + random.standard_t(4, size=(count, 3)) * size

    true, predicted = frames(600)
    true[:, 1] = np.nan
    true[5:, 0] = np.nan
    axes = fit_errors(predicted, true, np.repeat([f"{number}" for number in range(12)], 50))
    assert axes[0] is None
    assert axes[1] is None
    found = replace(INTERVALS, axes=(None, None, axes[2]))
    true, predicted = frames(20_000)
    low, high = found.of(predicted)
    assert np.isnan(low[:, :2]).all()
    assert np.isnan(high[:, :2]).all()
    inside = (low[:, 2] <= true[:, 2]) & (true[:, 2] <= high[:, 2])
    assert 0.87 < inside.mean() < 0.93
    # At strong and weak forces alike.
    for part in (true[:, 2] < -7, true[:, 2] > -3):
        assert 0.84 < inside[part].mean() < 0.99


@pytest.mark.parametrize("count", few([1, 2, 4, 12], 2))
def test_intervals_from_few_indenters_are_wide_enough_for_a_new_one(count: int) -> None:
    random = np.random.default_rng(count)
    covered, pooled = [], []
    for _ in range(200):
        names = np.repeat([f"{number}" for number in range(count)], 60)
        sizes = 0.2 * np.exp(random.normal(0, 0.2, count))
        error = np.full((60 * count, 3), np.nan)
        error[:, 2] = random.normal(size=60 * count) * np.repeat(sizes, 60)
        axis = fit_errors(np.zeros_like(error), error, names)[2]
        assert axis is not None
        new = random.normal(size=500) * 0.2 * np.exp(random.normal(0, 0.2))
        low, high = replace(INTERVALS, axes=(None, None, axis)).of(np.zeros((500, 3)))
        inside = ((low[:, 2] <= new) & (new <= high[:, 2])).mean()
        covered.append(inside)
        pooled.append(np.mean(np.abs(new) <= np.quantile(np.abs(error[:, 2]), 0.9)))
    # A new indenter has 90 % of its frames within on average, and seldom fewer than 80 %.
    assert 0.89 < np.mean(covered) < 0.97
    assert np.mean(np.array(covered) >= 0.8) >= 0.85
    if count < 4:
        assert np.mean(pooled) < np.mean(covered) - 0.03
    assert beyond_largest(count) == pytest.approx(
        {1: 1.436, 2: 1.241, 4: 1.107, 12: 1.0}[count], abs=2e-3
    )


def test_an_indenter_with_many_frames_counts_as_one_with_few() -> None:
    names = np.array(["small"] * 900 + ["large"] * 100)
    error = np.full((1000, 3), np.nan)
    error[:900, 2], error[900:, 2] = np.linspace(0, 0.1, 900), np.linspace(0, 1.0, 100)
    axis = fit_errors(np.zeros((1000, 3)), error, names)[2]
    assert axis is not None
    # 90 % of both alike: all of the small ones, and those up to 0.8 of the large ones.
    assert axis.base == pytest.approx(0.8 * beyond_largest(2), abs=0.02)


def test_an_interval_contains_the_model_s_error_and_all_assumed_scales(tmp_path: Path) -> None:
    forces = np.array([[0.5, 0.0, -4.0], [-0.5, 0.0, 0.0]])
    low, high = replace(INTERVALS, scale=ASSUMED).of(forces)
    error = 0.2 + 0.1 * math.hypot(0.5, 4.0)
    assert low[0, 2] == pytest.approx(-4 - math.hypot(error, 4.0))
    assert high[0, 2] == pytest.approx(-4 + math.hypot(error, 2.0))
    assert low[0, 0] <= 0.25
    assert high[0, 0] >= 1.0
    assert low[1, 0] <= -1.0
    assert high[1, 0] >= -0.25
    assert high[1, 2] - low[1, 2] == pytest.approx(2 * (0.2 + 0.1 * 0.5))
    assert np.isnan([low[0, 1], high[0, 1]]).all()
    forces = np.array([[0, 9, -9], [0, 0, -11], [1.5, 0, 0], [0, 0, 0]])
    where = shapes(1, 1, 1, 4.3)
    assert INTERVALS.is_outside(forces, where).tolist() == [False, True, True, True]
    twice = INTERVALS.rescaled(2.0, ASSUMED)
    assert twice.is_outside(forces, where).tolist() == [False, False, False, True]
    assert twice.axes[2] == AxisError(0.4, 0.1)
    assert twice.largest == (2.0, None, 20.0)
    twice.write(tmp_path)
    assert read_intervals(tmp_path) == twice
    assert read_intervals(tmp_path / "none") is None
    path = tmp_path / "intervals.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "format_version": 1}))
    with pytest.raises(LearningError, match=r"json: found format .*intervals', 1, .*repeating"):
        read_intervals(tmp_path)
    path.write_text('{"format": "tactile-rig intervals"}')
    with pytest.raises(LearningError, match="damaged"):
        read_intervals(tmp_path)


def test_weights_fix_the_scale_as_far_as_the_model_sees_them() -> None:
    exact = [ScaleSample(-known, -2.0 * known, 0.0) for known in (0.5, 1.0, 2.0)]
    value, scale = measured_scale(exact, ASSUMED, "weights")
    assert value == pytest.approx(0.5)
    assert (scale.factor, scale.assumed) == (pytest.approx(1.0), False)
    # An error of 10 % of the force leaves 10 %; weights far below the error change little.
    value, scale = measured_scale([ScaleSample(-1.0, -2.0, 0.2)], ASSUMED, "a weight")
    assert 0.5 < value < 0.53
    assert 1.08 < scale.factor < 1.1
    value, scale = measured_scale([ScaleSample(-0.01, -0.02, 0.5)], ASSUMED, "a feather")
    assert 0.9 < value < 1.0
    assert 1.9 < scale.factor < 2.0
    # Where errors grow with the force, a strong weight tells as much as a light one, not all.
    mixed = [ScaleSample(-1.0, -2.0, 0.4), ScaleSample(-4.0, -4.0, 0.8)]
    value, scale = measured_scale(mixed, Scale(100.0, "unknown", assumed=True), "weights")
    assert value == pytest.approx(math.sqrt(0.5), rel=0.02)
    # Their errors are alike, so two tell no more than one.
    assert scale.factor == pytest.approx(1.2, rel=0.02)
    pulling = [ScaleSample(-1.0, -1.0, 0.1), ScaleSample(-1.0, 0.1, 0.1)]
    with pytest.raises(LearningError, match="weight 2: its force is -1"):
        measured_scale(pulling, ASSUMED, "a weight")


def test_holds_of_a_live_recording_are_its_settled_contacts(tmp_path: Path) -> None:
    path = tmp_path / "holds.csv"
    force, contact = [], []
    for level in (-0.5, -1.0):
        force += [0.0] * 20 + [level * 3] * 3 + [level] * 40
        contact += [0] * 20 + [1] * 43
    force += [0.0] * 20 + [-0.2] * 4 + [0.0] * 20  # a touch of a hand
    contact += [0] * 20 + [1] * 4 + [0] * 20
    contact[50] = 0  # a flicker

    def write(values: list[float]) -> None:
        lines = [f"{v},{c}" for v, c in zip(values, contact, strict=True)]
        path.write_text("\n".join(["Fz_N,contact", *lines]))

    write(force)
    assert forces_of_holds(path, 2) == [-0.5, -1.0]
    with pytest.raises(LearningError, match=r"found 2 holds \(43 frames, 43 frames\); allowed: 3"):
        forces_of_holds(path, 3)
    write([*force[:100], *np.linspace(-1, -2, 26), *force[126:]])
    with pytest.raises(LearningError, match="hold 2 varies"):
        forces_of_holds(path, 2)
    path.write_text("Fz_N\n1\n")
    with pytest.raises(LearningError, match="Fz_N and contact"):
        forces_of_holds(path, 1)
    assert calibrate_force.weights("50g, 0.2kg") == [0.05, 0.2]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> tuple[MarkerArchive, MarkerArchive]:
    """A sensor with a gauge; another, pressed at the same places, with more frames a phase."""
    folder = tmp_path_factory.mktemp("recordings")
    made = {"targets": 2, "displacement": False, "force_depth": 1}
    one = made_up_archive(folder / "a.markers.zarr", ["dots"], **made)
    return one, made_up_archive(folder / "b.markers.zarr", ["grid"], **made, frames_per_phase=3)


def test_labels_of_the_target_stay_behind_and_the_source_s_meet_its_frames(
    recordings: tuple[MarkerArchive, MarkerArchive], tmp_path: Path
) -> None:
    one, other = recordings
    sensors = SensorSelection(one, "dots", "dots"), SensorSelection(other, "grid", "grid")
    for keep in (False, True):
        out = tmp_path / f"{keep}.markers.zarr"
        archive, _ = join_pair(*sensors, out, Tolerances(), None, keep_curve=keep)
        table, own = archive["grid"].table, other["grid"].table
        located = own["location"] >= 0
        assert np.isnan(table["wrench"][located]).all()
        assert np.isfinite(own["wrench"]).all()
        kept = own["wrench"][~located] if keep else np.full((int((~located).sum()), 6), np.nan)
        assert np.array_equal(table["wrench"][~located], kept, equal_nan=True)
        assert np.array_equal(table["frame"], own["frame"])  # row k is row k
        assert np.array_equal(archive["dots"].table["wrench"], one["dots"].table["wrench"])
    typed, out = tmp_path / "typed.csv", tmp_path / "typed.markers.zarr"
    typed.write_text("indenter,target,fz_n\nsphere,1,-1.25\nprism,0,-2.5\n")
    labelled, _ = join_pair(
        *sensors, out, Tolerances(), None, source_labels=typed, keep_curve=False
    )
    wrench = labelled["dots"].table["wrench"]
    rows, axes = np.isfinite(wrench).nonzero()
    assert axes.tolist() == [2, 2]
    assert sorted(wrench[rows, 2]) == [-2.5, -1.25]
    assert np.isnan(labelled["grid"].table["wrench"]).all()
    source = archive["dots"].table
    found = labels_by_place(source, source["wrench"][:, :3].astype(float), table)
    true = own["wrench"][:, :3] / 1.6  # the skins differ by this factor alone
    assert np.isfinite(found[located]).all()
    assert np.isnan(found[~located]).all()
    ends = located & (table["frame"] % 3 == 0)
    assert np.allclose(found[ends], true[ends], atol=1e-5)
    # Between frames of the source, labels are interpolated.
    assert np.abs(found[located] - true[located]).max() < 0.2


def test_a_few_labels_set_the_scale_and_measure_the_error(
    recordings: tuple[MarkerArchive, MarkerArchive], tmp_path: Path
) -> None:
    _, other = recordings
    table = other["grid"].table
    path = tmp_path / "few.csv"
    rows = np.flatnonzero(table["location"] >= 0)
    lines = ["indenter,target,frame,fx_n,fy_n,fz_n"]
    for row in rows[::4].tolist():
        name, force = other.indenters[table["indenter"][row]], table["wrench"][row]
        lines.append(f"{name},{table['target'][row]},{table['frame'][row]},,,{force[2]}")
    path.write_text("\n".join(lines))
    few = read_labels(path, other, "grid")
    assert few.rows.tolist() == rows[::4].tolist()
    assert np.isnan(few.forces[:, :2]).all()
    predicted = table["wrench"][few.rows, :3] / 1.6
    intervals = replace(INTERVALS, axes=(None, None, AxisError(0.05, 0.0)), scale=ASSUMED)
    gains, scale, _ = gains_of_labels(few, predicted, intervals)
    assert gains == pytest.approx([1.6] * 3, rel=0.01)
    assert scale.factor < 1.05
    for text, message in (
        ("indenter,target\ncone,0", "missing a column of forces; allowed: .* some of fx_n, fy_n"),
        ("indenter,fz_n\ncone,1", "missing target; allowed"),
        ("indenter,target,fz_n\nmoon,0,1", "has no frame where it is held of target 0 of moon"),
        (f"{lines[0]}\ncone,0,77,,,1", "has no frame 77 of target 0 of cone"),
        (f"{lines[0]}\ncone,0,1,,,x", "line 2: could not convert"),
        (f"{lines[1]}\n", "missing"),
        (f"{lines[0]}\ncone,0,1,,,", "found no force"),
        (f"{lines[0]}\ncone,0,1,,,1\ncone,0,1,,,1", "twice"),
    ):
        path.write_text(text)
        with pytest.raises(LearningError, match=message):
            read_labels(path, other, "grid")


def test_readings_typed_in_are_labels_where_a_press_is_held(
    recordings: tuple[MarkerArchive, MarkerArchive], tmp_path: Path
) -> None:
    _, other = recordings
    path = tmp_path / "typed.csv"
    path.write_text("indenter,target,fz_n\nsphere,1,-1.25\nprism,0,-2.5\n")
    labels = read_labels(path, other, "grid")
    table = other["grid"].table
    assert table["phase"][labels.rows].tolist() == [PHASES.index("normal_inc")] * 2
    assert table["target"][labels.rows].tolist() == [1, 0]
    # The deepest frame of the press.
    for row in labels.rows:
        press = table["location"] == table["location"][row]
        assert table["depth"][row] == table["depth"][press].max()
    assert np.array_equal(labels.forces[:, 2], [-1.25, -2.5])
    assert np.isnan(labels.forces[:, :2]).all()
    assert labels.presses == 2


def test_labels_of_five_presses_give_each_measured_axis_its_own_factor() -> None:
    random = np.random.default_rng(0)
    press = np.repeat(np.arange(12), 4)
    predicted = random.uniform(0.2, 1.0, (48, 3)) * [0.5, 0.5, -4.0]
    true = predicted * [1.1, 1.9, 1.5] + random.normal(0, 0.01, (48, 3))
    true[:, 1] = np.nan  # never measured
    true[press >= 4, 0] = np.nan  # measured in four presses alone
    intervals = replace(INTERVALS, axes=(AxisError(0.05, 0.0),) * 3, scale=ASSUMED)
    labels = Labels(np.arange(48), true, press)
    gains, scale, text = gains_of_labels(labels, predicted, intervals)
    assert gains[2] == pytest.approx(1.5, rel=0.01)
    assert gains[0] == gains[1] == pytest.approx(1.5, rel=0.02)  # the common factor
    assert "factors of Fx, Fy, Fz" in text
    assert not scale.assumed
    one = Labels(np.arange(4), true[:4], press[:4])
    assert np.ptp(gains_of_labels(one, predicted[:4], intervals)[0]) == 0
    shear = true.copy()
    shear[:, 0] = 1.1 * predicted[:, 0]
    measured = Labels(np.arange(48), shear, press)
    gains, _, _ = gains_of_labels(measured, predicted, intervals)
    assert gains == pytest.approx([1.1, gains[1], 1.5], rel=0.01)
    twice = intervals.rescaled([1.0, 1.0, 2.0], KNOWN)
    assert [one.base for one in twice.axes if one] == pytest.approx([0.05, 0.05, 0.1])
    assert twice.largest == (1.0, None, 20.0)


def test_unmeasured_axes_are_neither_scored_nor_covered() -> None:
    predicted = np.array([[0.5, 0.3, -4.0], [0.1, 0.2, -1.0], [0.0, 0.0, -2.0]])
    true = np.array([[np.nan, np.nan, -4.1], [np.nan, 0.0, -9.0], [np.nan, 0.1, np.nan]])
    found = score_of(NewFrames(predicted, true, shapes(1, 1, 9), ("cone",), INTERVALS))
    assert found.covered[2] == 0.5
    assert np.isnan(found.covered[:2]).all()
    assert found.coverage == 0.5
    assert found.errors.axes == ("Fy", "Fz")
    assert found.outside == pytest.approx(1 / 3)
    *_, fz, _, _ = found.lines()
    assert fz.endswith("covers 50.0 %")
    assert any(line.startswith("Fy: ") and line.endswith("no interval") for line in found.lines())


def test_a_model_by_another_sensor_s_labels_reads_none_of_its_own(
    recordings: tuple[MarkerArchive, MarkerArchive],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("learning.transfer.deliver.export_onnx", lambda model, out: 0.0)
    one, other = recordings
    # The same frames without forces.
    made = {"targets": 2, "displacement": False, "force_depth": 1, "frames_per_phase": 3}
    bare = made_up_archive(tmp_path / "bare.markers.zarr", ["grid"], **made, unlabelled=["grid"])
    words = ["--source", f"{one.path}:dots", "--by", "source", "--ways", "ridge"]
    made_from = []
    for archive in (other, bare):
        out = tmp_path / f"run-{archive.path.name}"
        assert run_module(force, *words, "--sensor", archive.path, "--out", out) == 0
        told = capsys.readouterr().out
        assert "**Scale assumed**: assumed that grid takes 1 times the force of dots" in told
        assert "**Scale assumed**" in (out / "card.md").read_text()
        made_from.append([(out / f).read_bytes() for f in ("model.safetensors", "intervals.json")])
    assert made_from[0] == made_from[1]
    # Weights set the scale.
    weighed = tmp_path / "weighed"
    row = int(np.flatnonzero(other["grid"].table["location"] < 0)[2])
    rows = ["--archive", f"{other.path}:grid", "--rows", row]
    run_module(calibrate_force, out, "--weights", "500g", *rows, "--out", weighed)
    before, after = read_intervals(out), read_intervals(weighed)
    assert before is not None
    assert after is not None
    assert (before.scale.assumed, after.scale.assumed) == (True, False)
    card = (weighed / "card.md").read_text()
    assert "**Scale known**: weights laid on the sensor: 4.903 N: factor" in card
    assert "**Scale assumed**" not in card
    capsys.readouterr()
    run_module(evaluate, weighed, f"{other.path}:grid")
    assert capsys.readouterr().out.splitlines()[-1].startswith("unlabelled sensor: R2 ")
    pairs = out / "steps" / "pairs.markers.zarr"
    assert np.isnan(MarkerArchive(pairs)["grid"].table["wrench"]).all()
    run_module(predict, weighed, pairs, "--sensor", "grid", "--out", tmp_path / "p.npz")
    assert "no label to compare with" in capsys.readouterr().out
    found = read_predictions(tmp_path / "p.npz")
    assert found.method == "transferred"
    assert (found.low < found.predicted).all()
    assert (found.predicted < found.high).all()
    # So do a few labels.
    typed = tmp_path / "typed.csv"
    typed.write_text("indenter,target,fz_n\nsphere,0,-4.0\n")
    named = ["--sensor", f"{bare.path}:grid", "--labels", typed]
    assert run_module(force, *words, *named, "--out", out) == 0
    assert "scale from 1 labelled presses of the target: factor" in capsys.readouterr().out
    assert read_intervals(out / "scaled") != read_intervals(out)
    # A force-depth curve of the target is a force reference: labels are scaled by it.
    out, named = tmp_path / "curved", ["--sensor", other.path]
    assert run_module(force, *words, *named, "--priors", other.path, "--out", out) == 0
    assert "**Scale known**: force-depth curves" in (out / "card.md").read_text()


def test_labels_that_twins_of_both_scale_have_the_target_s_scale(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("learning.transfer.deliver.export_onnx", lambda model, out: 0.0)
    words: list[Any] = ["--by", "source", "--ways", "ridge", "--out", tmp_path / "run"]
    archives = {}
    for name, role in (("dots", "--source"), ("grid", "--sensor")):
        path = tmp_path / f"{name}.markers.zarr"
        archives[name] = made_up_archive(path, [name], frames_per_phase=2, displacement=False)
        write_twin(archives[name], name, 0.9 * archives[name][name].table["wrench"][:, :3], 0.01)
        words += [role, f"{path}:{name}"]
    assert run_module(force, *words) == 0
    assert "**Scale known**: twins of both skins" in capsys.readouterr().out
    # The largest force learned from is the target's, of indenters that may be learned from.
    intervals = read_intervals(tmp_path / "run")
    assert intervals is not None
    table = archives["grid"]["grid"].table
    true = np.abs(table["wrench"][(table["location"] >= 0) & table["seen"], 2]).max()
    assert intervals.largest[2] == pytest.approx(true, rel=1e-3)
