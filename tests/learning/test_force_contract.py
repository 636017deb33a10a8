"""The contract of force models, which ours and one of another package keep."""

import re
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.commands import run_module
from support.force_models import TOY, noise_presses, toy
from support.foreign_model import installed
from support.made_up_archives import made_up_archive
from support.training import session

from learning.cli import predict
from learning.data.presses import Presses
from learning.errors import LearningError
from learning.evaluation.predictions import read_predictions
from learning.force import command
from learning.force.export import export_onnx, random_frames, torch_stream
from learning.force.live import open_live
from learning.force.loading import load_force_model
from learning.force.model import AXES, KIND, ForceModel, InputSettings, prepare
from learning.force.stream import open_exported
from learning.force.train import ForceModelSettings, read_force_settings, train_force
from learning.training.checkpoint import read_model_folder
from learning.training.run import RunFolder
from learning.translation.loading import hash_of

FOREIGN = "mean-force"
foreign = installed()


SETTINGS = {
    "ours": toy(network=replace(TOY.network, encoder_norm="instance", tail_norm="batch")),
    "frames alone, labels of Fz alone": toy(input=replace(TOY.input, alone=True)),
    "field": toy(
        input=InputSettings(form="field"),
        network=replace(TOY.network, encoder_norm="batch", tail_norm="batch"),
    ),
}


@dataclass(frozen=True)
class Trained:
    """A model that was trained for two epochs, its folder, and presses as it learned from."""

    settings: ForceModelSettings
    presses: Presses
    model: ForceModel
    folder: Path


@pytest.fixture(scope="module", params=[*SETTINGS, FOREIGN])
def trained(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, foreign: None
) -> Trained:
    if request.param == FOREIGN:
        tiny = read_force_settings("tiny", ["plugin=mean-force"])
        settings = toy(plugin=FOREIGN, network=tiny.network, input=tiny.input)
    else:
        settings = SETTINGS[request.param]
    presses = noise_presses(form=settings.input.stored_form)
    if "Fz alone" in request.param:
        presses.wrench[:, :2] = torch.nan
    folder = tmp_path_factory.mktemp("run") / "model"
    run = RunFolder.open(folder, KIND, settings, "noise")
    model = train_force(presses, settings, session(settings, run))
    return Trained(settings, presses, model, folder)


def test_the_module_of_the_guide_is_a_force_model() -> None:
    guide = (Path(__file__).parents[2] / "docs/reference/learning.md").read_text()
    known: dict[str, Any] = {}
    exec(re.findall(r"```python\n(.*?)```", guide, flags=re.S)[-1], known)
    model: ForceModel = known["load"](None, "cpu")
    settings = toy(network=model.network, input=model.inputs)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("learning.force.train.new_force_model", lambda *_: known["load"](None, "cpu"))
        trained = train_force(noise_presses(), settings)
    assert isinstance(trained.encoder[0], torch.nn.AvgPool2d)
    assert np.isfinite(trained.predict(noise_presses())).all()


def test_a_trained_model_opens_as_it_was(trained: Trained) -> None:
    model = load_force_model(trained.folder)
    assert read_model_folder(trained.folder, KIND).settings(ForceModelSettings) == trained.settings
    assert (model.network, model.inputs) == (trained.settings.network, trained.settings.input)
    assert not model.training
    forces = model.predict(trained.presses)
    assert forces.shape == (trained.presses.frames, len(AXES))
    assert np.array_equal(np.isfinite(forces), np.isfinite(trained.presses.wrench.numpy()))
    assert np.array_equal(forces, trained.model.predict(trained.presses), equal_nan=True)


def test_parts_of_a_sequence_and_single_frames_give_the_forces_of_the_whole(
    trained: Trained,
) -> None:
    model = trained.model
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
            first, state = model(prepared[None, :2])
            rest, _ = model(prepared[None, 2:], state)
            assert torch.allclose(torch.cat((first, rest), 1), whole, atol=1e-5)
    assert ((torch.cat(steps) >= 0) & (torch.cat(steps) <= 1)).all()


@pytest.mark.slow
def test_frames_streamed_through_torch_and_the_exported_file_give_the_forces_of_presses(
    trained: Trained,
) -> None:
    model, presses = trained.model, trained.presses
    assert export_onnx(model, trained.folder / "model.onnx") < 1e-4
    whole = model.predict(presses)
    for stream in (torch_stream(model), open_exported(trained.folder, threads=1)):
        steps = []
        for first, end in pairwise(presses.starts.tolist()):
            stream.reset(presses.references[0].numpy() if model.inputs.needs_reference else None)
            steps += [stream.step(frame) for frame in presses.images[first:end].numpy()]
        assert np.allclose(steps, whole, atol=1e-4, equal_nan=True)


@pytest.mark.slow
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
