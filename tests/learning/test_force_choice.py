"""Choice of the way to forces: closed-form models, nested errors, and the command."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from support.commands import run_module
from support.force_models import noise_presses
from support.foreign_model import installed
from support.made_up_archives import made_up_archive, write_twin

from learning.choice.candidates import candidates_of, with_codes, without
from learning.choice.evidence import read_evidence
from learning.choice.nested import Labelled, choose, folds_of, simplest
from learning.cli import calibrate_force, evaluate, predict
from learning.data.presses import Presses
from learning.errors import LearningError
from learning.force.closed_form import INPUTS, fit_closed_form, statistics
from learning.force.export import torch_stream
from learning.force.intervals import read_intervals, shapes_of_shading
from learning.force.loading import load_force_model
from learning.force.made_for import origin_of
from learning.force.model import ForceModel, prepare
from learning.training.checkpoint import Config, save_weights
from recorder import MarkerArchive
from tactile import force

ROOT = Path(__file__).parents[2]


def test_statistics_are_spreads_steps_and_the_mean_of_a_field() -> None:
    frames = torch.randn(2, 3, 32, 32, generator=torch.Generator().manual_seed(0)) * 0.05
    values = statistics(frames, "field").numpy()
    one = frames[1].numpy().astype(np.float64)
    down, across = np.diff(one, axis=1)[:, :, :-1], np.diff(one, axis=2)[:, :-1]
    steps = np.hypot(down, across).reshape(3, -1)
    planes = one.reshape(3, -1)
    large = (steps.mean(axis=0) > 0.1).mean()
    wanted = [*planes.std(axis=1), *steps.mean(axis=1), *planes.mean(axis=1)]
    wanted += [large, np.percentile(steps.mean(axis=0), 99)]
    assert 0 < large < 1
    assert values[1] == pytest.approx(wanted, abs=1e-5)
    assert statistics(frames, "shading").numpy()[1, 6:9] == pytest.approx(steps.std(axis=1), 1e-4)


def planted(presses: Presses) -> Presses:
    """Return presses whose forces are linear in means of a field's planes; Fy has no label."""
    means = presses.images.mean(dim=(2, 3))
    wrench = means @ torch.tensor([[1.0, 0, 2], [0, 0, 1], [0, 0, -3]])
    wrench[:, 1] = torch.nan
    return replace(presses, wrench=wrench)


@pytest.mark.parametrize("features", ["mean", "statistics", "grid", "kernel"])
def test_a_model_in_closed_form_is_stored_and_streamed_alike(features: str, tmp_path: Path) -> None:
    presses = planted(noise_presses(12, 5, form="field"))
    archive = made_up_archive(tmp_path / "a.markers.zarr", ["dots"], targets=1, frames_per_phase=1)
    way = next(each for each in candidates_of(archive["dots"]) if each.features == features)
    model = way.train(presses, 0, frozenset())
    predicted = model.predict(presses)
    assert np.isnan(predicted[:, 1]).all()
    true = presses.wrench.numpy()
    if features == "mean":
        assert predicted[:, 2] == pytest.approx(float(true[:, 2].mean()), abs=1e-5)
    if features == "grid":
        off = predicted[:, [0, 2]] - true[:, [0, 2]]
        assert np.square(off).mean() < 0.2 * np.nanvar(true)
    Config("force", way.settings(model, 0, presses), "", "").write(tmp_path)
    save_weights(model, tmp_path / "model.safetensors")
    again = load_force_model(tmp_path)
    assert again.predict(presses) == pytest.approx(predicted, nan_ok=True)
    frame = presses.images[7].numpy()
    assert torch_stream(again).step(frame) == pytest.approx(predicted[7], abs=1e-4, nan_ok=True)


def test_penalties_are_chosen_on_indenters_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    presses = replace(noise_presses(12, 5, form="field"), indenter=torch.arange(12) % 4)
    random = torch.randn(presses.wrench.shape, generator=torch.Generator().manual_seed(1))
    presses = replace(presses, wrench=random)
    chosen = float(fit_closed_form(presses, "grid").weights.norm())
    monkeypatch.setattr("learning.force.closed_form.PENALTIES", (1e-4,))
    # Noise of the labels is answered by small weights.
    assert chosen < 0.5 * float(fit_closed_form(presses, "grid").weights.norm())


def test_the_fixed_ridge_does_not_follow_the_mean_colour() -> None:
    random = np.random.default_rng(0)
    frames = random.integers(100, 156, (3, 3, 128, 128), dtype=np.uint8)
    brighter = frames + np.array([20, 0, 5], np.uint8)[:, None, None]
    one, other = (
        statistics(prepare(torch.from_numpy(each), None, INPUTS["shading"]), "shading")
        for each in (frames, brighter)
    )
    assert torch.allclose(one, other, atol=1e-5)
    assert shapes_of_shading(frames) == pytest.approx(shapes_of_shading(brighter), abs=1e-6)
    assert shapes_of_shading(frames).shape == (3, 7)


def test_the_simplest_way_is_taken_that_no_other_clearly_beats() -> None:
    ways = ["a", "b", "c"]
    errors = {
        "a": np.array([0.5, 0.4, 0.6, 0.5]),
        "b": np.array([0.11, 0.09, 0.12, 0.10]),
        "c": np.array([0.10, 0.11, 0.09, 0.11]),
    }
    assert simplest(ways, errors) == "b"
    assert simplest(ways, errors | {"c": np.array([0.05, 0.04, 0.05, np.nan])}) == "c"
    assert simplest(ways, errors | {"a": errors["b"] + 0.001}) == "a"


class Witness:
    """A way that predicts which indenters it has seen, and is right where it has seen one."""

    form = "field"

    def __init__(self, name: str, off: float) -> None:
        self.name, self.off = name, off
        self.trained: list[frozenset[int]] = []

    def train(self, presses: Presses, seed: int, without_codes: frozenset[int]) -> ForceModel:
        own = without(presses, without_codes)
        seen = set(own.indenter.tolist())
        self.trained.append(frozenset(seen))
        off = self.off

        class Model:
            def predict(self, tested: Presses) -> np.ndarray:
                new = ~np.isin(tested.indenter[tested.of_frame].numpy(), sorted(seen))
                return tested.wrench.double().numpy() + off * new[:, None]

        return Model()  # type: ignore[return-value]


def test_no_indenter_is_predicted_or_chosen_for_by_what_has_seen_it(tmp_path: Path) -> None:
    presses = noise_presses(10, 4, form="field")
    presses = replace(presses, indenter=torch.arange(10) % 5)
    of_frame = presses.indenter[presses.of_frame].numpy()
    labels = Labelled(presses.wrench.double().numpy(), of_frame)
    ways = [Witness("worse", 3.0), Witness("better", 1.0)]
    choice = choose(ways, {"field": presses}, labels, seed=0, kept=tmp_path)  # type: ignore[arg-type]
    assert choice.name == "better"
    # A way that had seen an indenter would be off by 0.
    assert choice.nested - labels.forces == pytest.approx(1.0)
    assert choice.left_out - labels.forces == pytest.approx(1.0)
    assert {way for _, way in choice.by_fold} == {"better"}
    folds = folds_of(labels.codes, 0)
    assert sorted(code for fold in folds for code in fold) == labels.codes
    assert len(ways[0].trained) == 4 + 6
    # What is kept is not trained again; another seed has other folds.
    again = [Witness("worse", 3.0), Witness("better", 1.0)]
    choose(again, {"field": presses}, labels, seed=0, kept=tmp_path)  # type: ignore[arg-type]
    assert again[0].trained == []
    one = Labelled(labels.forces[:4], np.zeros(4, np.int64))
    with pytest.raises(LearningError, match="found on 1 indenters; allowed: two or more"):
        choose(again, {"field": presses}, one, seed=0, kept=tmp_path / "x")  # type: ignore[arg-type]


def test_codes_of_another_archive_are_those_of_this_one() -> None:
    presses = replace(noise_presses(3, 2, form="field"), indenter=torch.tensor([0, 1, 2]))
    moved = with_codes(presses, ["cone", "ball", "new"], ["ball", "cone"])
    assert moved.indenter.tolist() == [1, 0, -3]
    kept = without(moved, frozenset({0}))
    assert kept.indenter.tolist() == [1, -3]
    assert kept.frames == int(presses.starts.diff()[[0, 2]].sum())
    assert torch.equal(kept.images[-1], presses.images[-1])


def test_labels_that_say_nothing_of_a_new_indenter_are_refused() -> None:
    codes = np.repeat(np.arange(6), 5)
    forces = np.random.default_rng(0).normal(size=(30, 3))
    folds = folds_of(range(6), 0)
    Labelled(forces, codes).require(folds)
    some = forces.copy()
    some[codes > 0, 0] = np.nan  # Fx under one indenter
    with pytest.raises(LearningError, match=r"found Fx from .* under 1 indenters; allowed"):
        Labelled(some, codes).require(folds)
    forces[:, 2] = -1.0
    with pytest.raises(LearningError, match="found Fz from -1 to -1 N"):
        Labelled(forces, codes).require(folds)


foreign = installed()


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> MarkerArchive:
    path = tmp_path_factory.mktemp("choice") / "a.markers.zarr"
    return made_up_archive(path, ["dots"], unseen=(), targets=3)


def test_the_command_chooses_delivers_and_says_how_good_it_is(
    archive: MarkerArchive,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    words = ["--sensor", str(archive.path), "--ways", "mean,ridge,cells", "--unseen", ""]
    out = tmp_path / "model"
    assert run_module(force, *words, "--out", out) == 0
    told = capsys.readouterr().out
    assert "dots: by its own labels" in told
    assert "R2 on indenters left out: Fx" in told
    assert "90 % not guaranteed: 3 indenters are fewer than 9" in told
    weights = (out / "model.safetensors").read_bytes()
    intervals = read_intervals(out)
    assert intervals is not None
    assert intervals.indenters == ("cone", "prism", "sphere")
    assert load_force_model(out).axes == ("Fx", "Fy", "Fz")
    assert "| cells |" in (out / "card.md").read_text()
    assert re.search(r"marker motion.*; 90 % intervals Fx \+- \d", origin_of(out))
    # Again: what was left out is not trained again, and the model is the same.
    monkeypatch.setattr("learning.transfer.deliver.export_onnx", lambda model, out: 0.0)
    times = {file: file.stat().st_mtime_ns for file in (out / "steps" / "left-out").iterdir()}
    assert run_module(force, *words, "--out", out) == 0
    assert (out / "model.safetensors").read_bytes() == weights
    assert all(file.stat().st_mtime_ns == before for file, before in times.items())
    with pytest.raises(LearningError, match=r"choice\.json\.seed: found 0"):
        run_module(force, *words, "--seed", 1, "--out", out)
    with pytest.raises(LearningError, match="found no frame of an indenter beside"):
        run_module(evaluate, out, f"{archive.path}:dots")
    # All its indenters were learned: none is new, whatever an archive's split would say.
    with pytest.raises(LearningError, match="--role: found no frames of new_indenter"):
        run_module(predict, out, archive.path, "--out", tmp_path / "p.npz")
    rows = ["--archive", f"{archive.path}:dots", "--rows", 4]
    with pytest.raises(LearningError, match=r"its own labels, .* whose scale weights cannot"):
        run_module(calibrate_force, out, "--weights", "1kg", *rows, "--out", tmp_path / "w")
    with pytest.raises(LearningError, match="--unseen: found bal; allowed: sphere"):
        run_module(force, *words[:2], "--unseen", "bal", "--out", tmp_path / "b")
    with pytest.raises(LearningError, match="--force-ratio: found with labels by own"):
        run_module(force, *words, "--force-ratio", 2, "--out", tmp_path / "b")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "config.yaml").write_text("")
    with pytest.raises(LearningError, match="--out: found another model"):
        run_module(force, *words, "--out", tmp_path / "b")
    with pytest.raises(LearningError, match="--ways: found magic; allowed: mean, ridge"):
        run_module(force, *words[:2], "--ways", "magic", "--out", tmp_path / "c")


def test_forces_of_a_twin_are_labels_of_a_sensor_without_a_gauge(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("learning.transfer.deliver.export_onnx", lambda model, out: 0.0)
    path = tmp_path / "bare.markers.zarr"
    bare = made_up_archive(path, ["dots"], targets=1, unseen=(), unlabelled=["dots"])
    words = ["--sensor", str(path), "--ways", "ridge", "--out", str(tmp_path / "model")]
    with pytest.raises(LearningError, match=r"found labels of dots on 0 indenters and no twin's"):
        run_module(force, *words)
    labelled = made_up_archive(tmp_path / "b.markers.zarr", ["dots"], targets=1, unseen=())
    write_twin(bare, "dots", labelled["dots"].table["wrench"][:, :3], 0.02)
    assert run_module(force, *words) == 0
    assert "dots: by the forces of its twin" in capsys.readouterr().out
    intervals = read_intervals(tmp_path / "model")
    assert intervals is not None
    assert intervals.errors_from.startswith("forces of twin of dots")
    pressed = np.abs(labelled["dots"].table["wrench"][:, 2])
    pressed = pressed[(labelled["dots"].table["location"] >= 0) & (pressed > 0.25 * pressed.max())]
    assert intervals.scale.factor == pytest.approx(np.exp(1.6449 * np.median(0.02 / pressed)))
    assert run_module(force, *words[:2], "--explain") == 0
    assert "* the forces of its twin" in capsys.readouterr().out
    with pytest.raises(LearningError, match="--source: missing"):
        run_module(force, *words, "--by", "source")


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_another_sensor_s_net_is_a_way_and_begins_one(
    archive: MarkerArchive,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("learning.transfer.deliver.export_onnx", lambda model, out: 0.0)
    short = ("patience_epochs=null", "stages=[{epochs: 1, learning_rate: 0.001}]")
    monkeypatch.setattr("learning.choice.candidates.OVER", short)
    other = tmp_path / "b.markers.zarr"
    made_up_archive(other, ["grid"], ("cone", "sphere", "prism"), unseen=(), targets=1)
    words = ["--sensor", str(archive.path), "--source", f"{other}:grid", "--ways", "source,tuned"]
    assert run_module(force, *words, "--out", tmp_path / "model") == 0
    told = capsys.readouterr().out
    assert "chosen: " in told
    assert "a net on marker motion of grid" in told
    model = load_force_model(tmp_path / "model")
    # Whichever was chosen, it is a net whose forces are within its range of training.
    assert (model.high > model.low).all()


@pytest.mark.slow
def test_a_model_of_another_package_is_a_way(
    archive: MarkerArchive,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("learning.transfer.deliver.export_onnx", lambda model, out: 0.0)
    short = ("patience_epochs=null", "stages=[{epochs: 1, learning_rate: 0.001}]")
    monkeypatch.setattr("learning.choice.candidates.OVER", short)
    words = ["--sensor", str(archive.path), "--ways", "mean-force"]
    assert run_module(force, *words, "--out", tmp_path / "model") == 0
    assert "chosen: mean-force (a model of another package)" in capsys.readouterr().out
    assert type(load_force_model(tmp_path / "model")).__name__ == "MeanForce"
    with pytest.raises(LearningError, match="load returned Still; allowed: a ForceModel"):
        run_module(force, *words[:3], "still", "--out", tmp_path / "still")


def test_the_table_of_ways_is_that_of_the_experiments() -> None:
    measured = json.loads((ROOT / "docs" / "results" / "gauge.json").read_text())
    for row in read_evidence():
        for group in ("kinds", "skins", "patterns"):
            lines = measured[group]["results"]["lines"]
            line = next(
                each for each in lines if (each["way"], each["net"]) == (row["row"], row["net"])
            )
            assert row[group] == pytest.approx(line["sealed"], abs=6e-4), (row["way"], group)
