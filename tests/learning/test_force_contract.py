"""The contract of force models, which ours and one of another package keep."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from support.commands import run_module
from support.force_models import noise_presses, toy
from support.foreign_model import write_foreign_package
from support.made_up_archives import made_up_archive

from learning.cli import predict
from learning.errors import LearningError
from learning.evaluation.predictions import read_predictions
from learning.force import command
from learning.force.export import export_onnx, random_frames, torch_stream
from learning.force.live import open_live
from learning.force.model import AXES, KIND, ForceModel, load_force_model, prepare
from learning.force.stream import open_exported
from learning.force.train import read_force_settings, train_force
from learning.training.run import RunFolder, TrainingSession, accelerator
from learning.translation.loading import hash_of

NAMES = ("ours", "alone", "field", "mean-force")
FOREIGN = "mean-force"


@pytest.fixture(autouse=True)
def foreign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install the package `foreign-still`."""
    site = tmp_path / "site"
    site.mkdir()
    write_foreign_package(site)
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.delitem(sys.modules, "foreign_still", raising=False)


@pytest.fixture(params=NAMES)
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """The folder of a model that was trained for two epochs."""
    name = request.param
    settings = toy()
    if name == FOREIGN:
        settings = read_force_settings("tiny", ["plugin=mean-force", "sequences.batch=2"])
        settings = toy(plugin=FOREIGN, network=settings.network, input=settings.input)
    elif name != "ours":
        settings = toy(
            input=type(settings.input)(
                form="field" if name == "field" else "both", side_px=32, alone=name == "alone"
            )
        )
    presses = noise_presses(form=settings.input.stored_form)
    run = RunFolder.open(tmp_path / name, KIND, settings, "noise")
    train_force(presses, settings, TrainingSession(accelerator(settings.launch), run))
    return tmp_path / name


def test_a_trained_model_opens_as_it_was(folder: Path) -> None:
    model = load_force_model(folder)
    presses = noise_presses(form=model.inputs.stored_form)
    forces = model.predict(presses)
    assert forces.shape == (presses.frames, len(AXES))
    assert np.isfinite(forces).all()
    assert not model.training
    assert np.array_equal(forces, load_force_model(folder).predict(presses))


def test_frame_by_frame_is_the_whole_sequence(folder: Path) -> None:
    model = load_force_model(folder)
    frames = torch.from_numpy(random_frames(model, 5))
    reference = frames[:1] if model.inputs.needs_reference else None
    prepared = prepare(
        frames, None if reference is None else frames[:1].expand_as(frames), model.inputs
    )
    state, steps = model.initial_state(1), []
    assert state.shape == (1, *model.state_shape)
    with torch.no_grad():
        for frame in prepared:
            force, state = model.step(frame[None], state)
            steps.append(force)
        if not model.inputs.alone:
            whole, last = model(prepared[None])
            assert torch.allclose(torch.cat(steps), whole[0], atol=1e-5)
            assert torch.allclose(state, last, atol=1e-5)
    assert ((torch.cat(steps) >= 0) & (torch.cat(steps) <= 1)).all()


def test_the_exported_step_is_the_models(folder: Path) -> None:
    model = load_force_model(folder)
    assert export_onnx(model, folder / "model.onnx") < 1e-4
    first, *frames = random_frames(model, 4)
    streams = torch_stream(model), open_exported(folder)
    for stream in streams:
        stream.reset(first if model.inputs.needs_reference else None)
    for frame in frames:
        one, other = (stream.step(frame) for stream in streams)
        assert np.allclose(one, other, atol=1e-3)


def test_a_model_of_another_package_is_trained_predicts_and_runs_live(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    archive = made_up_archive(tmp_path / "x.markers.zarr", ("dots",), targets=3, frames_per_phase=1)
    words = ["--set", "plugin=mean-force", "--set", "stages=[{epochs: 1, learning_rate: 0.01}]"]
    # Sensor, split and folder are the only ones there can be.
    assert run_module(command, archive.path, *words) == 0
    run = tmp_path / "runs" / "force-dots"
    assert "trained on" in capsys.readouterr().out
    assert {"model.onnx", "card.md", "split.json"} <= {path.name for path in run.iterdir()}
    model = load_force_model(run)
    assert type(model).__name__ == "MeanForce"
    assert model.axes == AXES
    out = tmp_path / "p.npz"
    assert run_module(predict, run, archive.path, "--out", out) == 0
    assert read_predictions(out).key == ("dots", "dots", "target", "")
    assert open_live(run, preset_name="uskin") is not None
    # By its name alone it is a model that needs no folder.
    assert run_module(predict, FOREIGN, archive.path, "--out", tmp_path / "q.npz") == 0
    assert read_predictions(tmp_path / "q.npz").model == hash_of(FOREIGN)
    assert open_live(FOREIGN, preset_name="uskin") is not None


@pytest.mark.parametrize(
    ("name", "message"),
    [("nothing", "returned int; allowed: a ForceModel"), ("still", "returned Still; allowed")],
)
def test_what_is_no_force_model_is_refused(name: str, message: str) -> None:
    with pytest.raises(LearningError, match=message):
        load_force_model(name)
    assert issubclass(ForceModel, torch.nn.Module)
