"""An experiment makes every result once, resumes where it stopped, and rejects other settings."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.force_models import TINY_FORCE
from support.foreign_model import installed
from support.made_up_archives import archive_of, made_up_archive, write_twin

from learning.config import preset_names, read_settings
from learning.data.images import shrink_masks
from learning.data.presses import Presses
from learning.data.splits import make_split
from learning.errors import LearningError
from learning.evaluation.predictions import Predictions, read_predictions
from learning.experiment import running, stages
from learning.experiment.frames import (
    as_images,
    flow_fields,
    load_some,
    look_of,
    pairs_of,
    thinned,
    translate_presses,
    warp_presses,
)
from learning.experiment.settings import PRESETS, ExperimentSettings
from learning.experiment.stages import Places, force_settings, translator_training
from learning.force.train import epoch, initial_model
from learning.metrics import force_errors
from learning.translation.flow import FlowTranslator
from learning.translation.translator import SensorView
from recorder import MarkerArchive
from tactile.run import main

pytestmark = pytest.mark.slow

CPU = torch.device("cpu")
SMALL = (TINY_FORCE, "fine_tuning=[]", "scored_presses=0", "compensation=[compensated, priors]")


archive = archive_of(targets=3, force_depth=2)
foreign = installed()


def settings(*changed: str) -> ExperimentSettings:
    return read_settings(ExperimentSettings, PRESETS, "demo", (*SMALL, *changed))


def run(archive: MarkerArchive, out: Path, *changed: str) -> list[str]:
    reported: list[str] = []
    report = running.run_experiment(
        Places(out, archive.path), settings(*changed), pairs=["dots:grid"], say=reported.append
    )
    return [*reported, running.gained(report.force)]


@pytest.fixture(scope="module")
def done(
    archive: MarkerArchive, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, list[str]]:
    """A complete experiment: its folder and its output."""
    out = tmp_path_factory.mktemp("done") / "out"
    with pytest.MonkeyPatch.context() as patch:
        undrawn(patch)
        return out, run(archive, out)


def test_a_translator_of_another_package_is_in_the_tables(
    archive: MarkerArchive, tmp_path: Path, foreign: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    undrawn(monkeypatch)
    run(archive, tmp_path / "out", "translators=[still]")
    assert results(tmp_path / "out", "transferred.still").translator == "still"


def results(out: Path, name: str) -> Predictions:
    return read_predictions(out / "results" / f"dots-to-grid.{name}.npz")


def training_presses(archive: MarkerArchive) -> Presses:
    return load_some(archive["dots"], make_split(archive), ["train"], None, 0, device=CPU)


def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the pictures out of reports; they take most of the time of a small experiment."""
    for drawn in ("_pictures", "_sequences"):
        monkeypatch.setattr(f"learning.evaluation.report.{drawn}", lambda *_: ())


def test_an_experiment_goes_from_presses_to_a_report_and_makes_nothing_twice(
    archive: MarkerArchive,
    done: tuple[Path, list[str]],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out, reported = done
    assert reported[-1].startswith("source-only R2 ")
    best = results(out, "priors.flow")
    unseen = best.only(best.role == "new_indenter")
    errors = force_errors(unseen.true, unseen.predicted, unseen.label_std)
    assert reported[-1].endswith(f"transferred R2 {errors.r2_mean:.3f}")
    assert (out / "report" / "report.html").is_file()
    found = results(out, "compensated.flow")
    assert set(found.role) == {"new_press", "new_indenter"}
    assert set(found.indenter[found.role == "new_indenter"]) == {"cone"}

    def refuse(*arguments: object, **options: object) -> None:
        raise AssertionError("trained again")

    monkeypatch.setattr(stages, "train_force", refuse)
    undrawn(monkeypatch)
    assert run(archive, out) == [line for line in reported if "labels of >" not in line]
    words = ["experiment", str(archive.path), "--out", str(out), "--pairs", "dots:grid"]
    assert main([*words, *(f"--set={each}" for each in SMALL)]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[-1] == reported[-1]
    assert printed[-2].startswith(f"{out / 'report' / 'report.html'}: written, beside ")
    with pytest.raises(LearningError, match=r"experiment\.json\.seed: found 0, asked for 1"):
        run(archive, out, "seed=1")
    with pytest.raises(LearningError, match="models_per_batch: found 1, asked for 4"):
        run(archive, out, "models_per_batch=4")


def test_models_trained_together_say_what_those_trained_alone_say(
    archive: MarkerArchive,
    done: tuple[Path, list[str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    undrawn(monkeypatch)
    run(archive, tmp_path, "models_per_batch=4")
    with pytest.raises(LearningError, match="models_per_batch: found 4, asked for 1"):
        run(archive, tmp_path)
    alone, batched = (results(place, "compensated.flow") for place in (done[0], tmp_path))
    assert np.abs(alone.predicted - batched.predicted).max() < 1e-3
    assert not np.array_equal(alone.predicted, batched.predicted)


def test_the_papers_translator_is_chosen_like_any_other(
    archive: MarkerArchive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("peft", reason="peft is not installed: extra diffusion")
    from support.tiny_diffusion import DEEP_VAE, write_base

    few = [f"weights.base={write_base(tmp_path / 'sd-turbo', DEEP_VAE)}", "steps=1", "batch=1"]
    few += ["vae_rank=2", "launch.mixed_precision=no", "validated=1", "unet_rank=2"]
    few += ["losses={adversarial: 0, perceptual: 0, square: 1}", "marker_vae.mixed_precision=no"]
    few += ["marker_vae.steps=1", "marker_vae.batch=1"]
    chosen = [
        "translators=[diffusion]",
        "compensation=[compensated]",
        "diffusion=" + json.dumps({"preset": "ours", "set": few}),
    ]
    undrawn(monkeypatch)
    run(archive, tmp_path / "out", *chosen)
    # The training makes the marker VAE that it needs itself.
    assert (tmp_path / "out" / "models" / "diffusion" / "marker-vae" / "config.yaml").exists()
    assert np.isfinite(results(tmp_path / "out", "compensated.diffusion").predicted).all()
    with pytest.raises(LearningError, match=r"diffusion: weights\.base: found '' without unet"):
        run(archive, tmp_path / "other", "translators=[diffusion]")
    assert not (tmp_path / "other" / "models").exists()


def test_presses_translated_together_are_those_translated_one_by_one(
    archive: MarkerArchive,
) -> None:
    source, target = archive["dots"], archive["grid"]
    packed = training_presses(archive)
    look = look_of(target, packed, CPU)
    views = SensorView.of(source), SensorView.of(target)
    warped = warp_presses(packed, look, flow_fields(packed, *views))
    translator = FlowTranslator(*views)
    for press in range(len(packed)):
        rows = packed.rows[packed.starts[press] : packed.starts[press + 1]].numpy()
        alone = translator.translate(
            torch.from_numpy(source.masks(rows)),
            torch.from_numpy(target.reference(0)),
            torch.from_numpy(source.reference(0)),
            ordered=True,
        )
        batched = warped.images[packed.starts[press] : packed.starts[press + 1]]
        # Fields are stored in 16 bits: an edge may move by one pixel.
        assert (batched.int() - shrink_masks(alone).int()).abs().float().mean() < 0.5
    assert (warped.wrench == packed.wrench).all()
    assert warped.sensor == "dots-to-grid"


def test_without_memory_every_frame_has_no_contact_before(archive: MarkerArchive) -> None:
    packed = training_presses(archive)
    alone = packed.each_frame_alone()
    assert len(alone) == alone.frames == packed.frames > len(packed)
    assert torch.equal(alone.of_frame, torch.arange(packed.frames))
    assert torch.equal(alone.location, packed.location[packed.of_frame])
    assert alone.images is packed.images


def test_the_seed_of_an_experiment_is_that_of_its_trainings() -> None:
    def begun(*changed: str) -> tuple[torch.Tensor, list[int]]:
        chosen = force_settings(settings(*changed), "cpu")
        labels = [torch.tensor([[-1.0, -1.0, -2.0], [1.0, 1.0, 0.0]])]
        model = initial_model(labels, chosen, None, CPU)
        passed = epoch([np.arange(0, 90, 9)], [0], chosen.sequences, chosen.seed, 0)
        order = [int(press) for _, presses in passed.strings for press in presses]
        return torch.cat([each.flatten() for each in model.parameters()]), order

    weights, order = begun("seed=1")
    again, same_order = begun("seed=1")
    assert torch.equal(weights, again)
    assert order == same_order
    others, other_order = begun("seed=2")
    assert not torch.equal(weights, others)
    assert order != other_order
    for tuning in (False, True):
        assert force_settings(settings("seed=2"), "cpu", tuning=tuning).seed == 2
    own = settings("seed=2", "fine_tuning=[seed=5]", "translators=[field]")
    assert force_settings(own, "cpu").seed == 2
    assert force_settings(own, "cpu", tuning=True).seed == 5
    training = translator_training(own, "field")
    assert training is not None
    assert training[1].seed == 2


def test_frames_keep_their_places_in_translation(archive: MarkerArchive) -> None:
    class Same:
        name = "same"

        def translate(self, source: Any, target_reference: Any, *_: Any, **__: Any) -> Any:
            return source

    packed = training_presses(archive)
    shown = translate_presses(packed, look_of(archive["grid"], packed, CPU), Same())
    assert torch.equal(shown.images, as_images(packed).images)
    assert not torch.equal(shown.references, as_images(packed).references)


def test_a_thinner_split_moves_what_it_leaves_out_and_nothing_else(archive: MarkerArchive) -> None:
    split = make_split(archive, new_press=0.3, validation=0.0)
    few = thinned(split, 1, seed=0)
    assert len(few.locations("new_indenter")) == len(few.locations("new_press")) == 1
    assert np.array_equal(few.locations("train"), split.locations("train"))
    assert len(few.presses) == len(split.presses)
    few.check(archive)


def test_pairs_are_all_directed_ones_or_those_asked_for(archive: MarkerArchive) -> None:
    assert len(pairs_of(archive, None)) == 2
    with pytest.raises(LearningError, match="found 'dots:dots'; allowed: SOURCE:TARGET"):
        pairs_of(archive, ["dots:dots"])
    with pytest.raises(LearningError, match="two of dots, grid"):
        pairs_of(archive, ["dots:squares"])


@pytest.mark.parametrize("name", preset_names(PRESETS))
def test_presets_can_be_read(name: str) -> None:
    assert read_settings(ExperimentSettings, PRESETS, name).translators


@pytest.mark.parametrize(
    ("changed", "reported"),
    [
        ("field={preset: smoke}", "field: preset: found 'smoke'; known: "),
        ('field={preset: cpu_smoke, set: ["sed=2"]}', "field: .*unknown sed; did you mean"),
    ],
)
def test_mistakes_in_presets_used_later_are_refused_before_anything_is_written(
    changed: str, reported: str, archive: MarkerArchive, tmp_path: Path
) -> None:
    with pytest.raises(LearningError, match=f"^settings.{reported}"):
        run(archive, tmp_path / "out", "translators=[field]", changed)
    assert not (tmp_path / "out").exists()


@pytest.mark.timeout(600)
def test_learned_translators_are_trained_and_used(archive: MarkerArchive, tmp_path: Path) -> None:
    few = 'field={preset: cpu_smoke, set: ["field_stage.steps=2", "map_stage.steps=2"]}'
    run(archive, tmp_path, "translators=[field]", "compensation=[]", "scored_presses=1", few)
    for name in ("transferred.field", "field.scores"):
        assert (tmp_path / "results" / f"dots-to-grid.{name}.npz").is_file()


def test_an_experiment_trains_on_labels_by_simulation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "x.markers.zarr"
    some = made_up_archive(path, targets=3, frames_per_phase=2)
    with pytest.raises(LearningError, match="found no forces of a twin; allowed: tactile sim"):
        run(some, tmp_path / "none", "compensation=[simulated]")
    for name, sensor in some.items():
        write_twin(some, name, sensor.table["wrench"][:, :3], 0.01)
    undrawn(monkeypatch)
    reported = run(MarkerArchive(path), tmp_path / "out", "compensation=[simulated]")
    found = results(tmp_path / "out", "simulated.flow")
    errors = force_errors(found.true, found.predicted, found.label_std)
    assert any(f"simulated by flow: R2 {errors.r2_mean:.3f}" in line for line in reported)
    assert not (tmp_path / "out" / "compensation.json").exists()


def test_an_unlabelled_target_is_predicted_and_rows_by_its_labels_are_left_out(
    tmp_path: Path,
) -> None:
    path = tmp_path / "x.markers.zarr"
    some = made_up_archive(path, targets=3, frames_per_phase=2, force_depth=2, unlabelled=("grid",))
    reported: list[str] = []
    chosen = settings("compensation=[compensated, oracle]")
    report = running.run_experiment(
        Places(tmp_path / "out", some.path), chosen, say=reported.append
    )
    results = sorted(each.name for each in (tmp_path / "out" / "results").iterdir())
    assert results == ["dots-to-grid.source-only.npz", "dots-to-grid.transferred.flow.npz"]
    found = read_predictions(tmp_path / "out" / "results" / results[1])
    assert np.isfinite(found.predicted).all()
    assert report.lines == ("grid: no label of Fx, Fy, Fz; predictions are not scored",)
    assert running.gained(report.force) == "no labels to compare with"
    assert any(line.startswith("grid: no labels in training presses") for line in reported)
    assert any(line.startswith("grid: no force-depth curve") for line in reported)
    with pytest.raises(LearningError, match="grid has no labels; allowed sources: dots"):
        pairs_of(some, ["grid:dots"])
