"""`tactile models`: a trained force model is published, listed, taken and used."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.commands import run_module
from support.force_models import TOY, noise_presses

from learning.cli import models as command
from learning.errors import LearningError
from learning.force import load_force_model
from learning.force.model import KIND
from learning.force.stream import open_exported
from learning.force.train import train_force
from learning.training.run import RunFolder, Session, accelerator
from recorder import models


def test_a_model_is_published_and_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    run, card = tmp_path / "run", tmp_path / "card.md"
    with RunFolder.open(run, KIND, TOY, "noise") as folder:
        train_force(noise_presses(), TOY, Session(accelerator(TOY.launch), folder))
    added = ["add", run, "--name", "small", "--to", "place", "--card", card]
    with pytest.raises(LearningError, match="--card: found no"):
        run_module(command, *added)
    card.write_text("# small\n\nForces from noise\n")
    assert run_module(command, *added) == 0
    assert run_module(command, "list", "--from", "place") == 0
    assert "small: 0." in (told := capsys.readouterr().out)
    assert "MB, Apache-2.0; Forces from noise" in told

    assert run_module(command, "get", "small", "--from", "place") == 0
    assert run_module(command, "use", "small") == 0
    found = models.find(None)
    assert found is not None
    assert {path.name for path in found.iterdir()} == {
        *("card.md", "config.yaml", "model.onnx", "model.safetensors")
    }
    frames = noise_presses().images.numpy()
    stream = open_exported(found / "model.onnx")
    stream.reset(frames[0])
    expected = load_force_model(run).predict(noise_presses())
    assert np.isfinite(stream.step(frames[0])).all()
    assert np.allclose(load_force_model(found).predict(noise_presses()), expected)
