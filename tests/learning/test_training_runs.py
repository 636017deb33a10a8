"""Run folders: a training that is stopped at any point resumes with identical results."""

import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch import nn

from learning.errors import LearningError
from learning.training.checkpoint import (
    load_weights,
    read_config,
    read_model_folder,
    read_weights,
    save_weights,
)
from learning.training.optim import Cosine, set_rate
from learning.training.run import RunFolder, generator, seed_torch


@dataclass(frozen=True, slots=True)
class Toy:
    width: int = 8
    steps: int = 40
    seed: int = 3


@dataclass(frozen=True, slots=True)
class Described:
    description: str
    seed: int = 3


class Net(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(4, width), nn.BatchNorm1d(width), nn.Dropout(0.2), nn.Linear(width, 1)
        )

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        return self.layers(values)


def _train(folder: Path, until: int) -> Net:
    """Train with momentum and dropout up to some step, saving every 10 steps."""
    toy = Toy()
    seed_torch(toy.seed, "weights")
    net = Net(toy.width)
    optimiser = torch.optim.AdamW(net.parameters())
    rate = Cosine(1e-2, steps=toy.steps, warm_up=5)
    run = RunFolder.open(folder, "force", toy, "data", metadata={"range": [1.0, 2.0]})
    for step in range(run.restore({"model": net}, {"optimiser": optimiser}), until):
        seed_torch(toy.seed, "step", step)
        values = torch.from_numpy(generator(toy.seed, "batch", step).normal(size=(16, 4)))
        set_rate(optimiser, rate.at(step))
        loss = (net(values.float()) - values.float().sum(1, keepdim=True)).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        run.log(step + 1, {"train/loss": loss.item()})
        if (step + 1) % 10 == 0:
            states = {"optimiser": optimiser}
            run.save(step + 1, {"model": net}, states, score=abs(step - 14.0))
    if until == toy.steps:
        run.finish(until, {"model": net})
    return net


def _losses(folder: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def test_two_halves_are_the_whole_bit_for_bit(tmp_path: Path) -> None:
    whole = _train(tmp_path / "whole", 40)
    _train(tmp_path / "halves", 20)
    torch.manual_seed(99)
    halves = _train(tmp_path / "halves", 40)
    for name, value in whole.state_dict().items():
        assert torch.equal(value, halves.state_dict()[name]), name
    assert _losses(tmp_path / "whole") == _losses(tmp_path / "halves")
    ends = [
        torch.load(tmp_path / name / "checkpoints/00000040/training.pt", weights_only=True)
        for name in ("whole", "halves")
    ]
    averages = [end["optimiser"]["state"][0]["exp_avg"] for end in ends]
    assert torch.equal(*averages)


def test_steps_after_the_last_checkpoint_are_taken_again(tmp_path: Path) -> None:
    whole = _train(tmp_path / "whole", 40)
    _train(tmp_path / "killed", 27)
    with (tmp_path / "killed/metrics.jsonl").open("a") as file:
        file.write('{"step": 28, "train/lo')
    resumed = _train(tmp_path / "killed", 40)
    assert torch.equal(whole.layers[0].weight, resumed.layers[0].weight)
    assert _losses(tmp_path / "killed") == _losses(tmp_path / "whole")


def test_a_kill_before_the_rename_leaves_the_checkpoint_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "run"
    _train(folder, 10)

    def killed(self: Path, target: Path) -> Path:
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "rename", killed)
    with pytest.raises(KeyboardInterrupt):
        _train(folder, 20)
    monkeypatch.undo()
    left = [path.name for path in (folder / "checkpoints").iterdir()]
    assert sorted(left) == [".writing-00000020", "00000010"]
    _train(folder, 20)
    left = [path.name for path in (folder / "checkpoints").iterdir()]
    assert sorted(left) == ["00000010", "00000020"]


def test_the_last_ones_and_the_best_are_kept(tmp_path: Path) -> None:
    _train(tmp_path / "run", 40)
    run = RunFolder.open(tmp_path / "run", "force", Toy(), "data")
    kept = sorted(path.name for path in (tmp_path / "run/checkpoints").iterdir())
    # Scores are |step - 15|: 10 and 20 are equal, and the older one is kept.
    assert kept == ["00000010", "00000030", "00000040"]
    assert run.best() == tmp_path / "run/checkpoints/00000010"
    assert run.latest() == tmp_path / "run/checkpoints/00000040"
    assert run.finished


def test_other_settings_or_data_are_refused_by_name(tmp_path: Path) -> None:
    _train(tmp_path / "run", 10)
    before = sorted((path, path.stat().st_mtime_ns) for path in (tmp_path / "run").rglob("*"))
    other = replace(Toy(), width=16, seed=4)
    with pytest.raises(LearningError, match=r"begun with other settings\.seed, settings\.width"):
        RunFolder.open(tmp_path / "run", "force", other, "data")
    with pytest.raises(LearningError, match="begun with other data; allowed: the same"):
        RunFolder.open(tmp_path / "run", "force", Toy(), "other")
    with pytest.raises(LearningError, match="begun with other kind"):
        RunFolder.open(tmp_path / "run", "field", Toy(), "data")
    after = sorted((path, path.stat().st_mtime_ns) for path in (tmp_path / "run").rglob("*"))
    assert before == after


def test_a_description_may_be_reworded(tmp_path: Path) -> None:
    RunFolder.open(tmp_path / "run", "force", Described("first words"), "data")
    RunFolder.open(tmp_path / "run", "force", Described("other words"), "data")
    other = Described("other words", seed=4)
    with pytest.raises(LearningError, match=r"begun with other settings\.seed; allowed"):
        RunFolder.open(tmp_path / "run", "force", other, "data")


def test_a_folder_nowhere_keeps_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _train(tmp_path / "run", 10)
    monkeypatch.chdir(tmp_path / "run")
    net, run = Net(8), RunFolder.nowhere()
    before = {name: value.clone() for name, value in net.state_dict().items()}
    assert (run.latest(), run.best(), run.finished) == (None, None, False)
    assert run.restore({"model": net}) == 0
    assert all(torch.equal(value, before[name]) for name, value in net.state_dict().items())
    files = sorted(tmp_path.rglob("*"))
    run.log(1, {"loss": 1.0})
    run.save(1, {"model": net}, {})
    run.finish(1, {"model": net})
    assert sorted(tmp_path.rglob("*")) == files


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(LearningError, match="holds something else"):
        RunFolder.open(tmp_path, "force", Toy(), "data")
    assert os.listdir(tmp_path) == ["notes.txt"]


def test_a_finished_run_is_a_model(tmp_path: Path) -> None:
    net = _train(tmp_path / "run", 40)
    found = read_model_folder(tmp_path / "run", "force")
    assert found.settings(Toy) == Toy()
    assert found.config.metadata == {"range": [1.0, 2.0]}
    assert (found.config.step, found.config.data) == (40, "data")
    assert len(found.hash()) == 64
    again = Net(8)
    found.load(again)
    assert torch.equal(again.layers[0].weight, net.layers[0].weight)
    assert set(found.weights()) == set(net.state_dict())
    # A checkpoint is a model folder as well.
    assert read_model_folder(tmp_path / "run/checkpoints/00000030").config.step == 30


def test_what_is_no_model_is_refused(tmp_path: Path) -> None:
    _train(tmp_path / "run", 10)
    with pytest.raises(LearningError, match=r"found no model\.safetensors; allowed: a finished"):
        read_model_folder(tmp_path / "run")
    with pytest.raises(LearningError, match="found kind 'force'; allowed: 'field'"):
        read_model_folder(tmp_path / "run", "field")
    with pytest.raises(LearningError, match=r"found no config\.yaml"):
        read_model_folder(tmp_path)
    (tmp_path / "config.yaml").write_text("kind: force\n")
    with pytest.raises(LearningError, match="settings: found nothing; allowed: a mapping"):
        read_config(tmp_path)


def test_weights_of_another_network_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    save_weights(Net(8), path)
    kept = {name: value.clone() for name, value in Net(16).state_dict().items()}
    wider = Net(16)
    wider.load_state_dict(kept)
    with pytest.raises(LearningError, match=r"layers\.0\.weight \(8, 4\), expected \(16, 4\)"):
        load_weights(wider, path)
    assert torch.equal(wider.layers[0].weight, kept["layers.0.weight"])
    with pytest.raises(LearningError, match=r"missing weight; unexpected layers\.0\.bias"):
        load_weights(nn.Linear(4, 8, bias=False), path)
    with pytest.raises(LearningError, match="found NaN or infinity in weight"):
        load_weights(nn.Linear(1, 1, bias=False), {"weight": torch.tensor([[torch.nan]])})


def test_damaged_weights_and_training_states_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    save_weights(Net(8), path)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(LearningError, match="corrupt or incomplete safetensors file"):
        read_weights(path)
    with pytest.raises(LearningError, match="no such file"):
        read_weights(tmp_path / "none.safetensors")
    _train(tmp_path / "run", 10)
    states = tmp_path / "run/checkpoints/00000010/training.pt"
    states.write_bytes(states.read_bytes()[:50])
    with pytest.raises(LearningError, match=r"training\.pt: damaged, or not plain states"):
        _train(tmp_path / "run", 20)


def test_states_that_could_not_be_read_back_are_not_kept(tmp_path: Path) -> None:
    run = RunFolder.open(tmp_path / "run", "force", Toy(), "data")
    with pytest.raises(LearningError, match="not plain states"):
        run.save(1, {"model": Net(8)}, {"course": SimpleNamespace(state_dict=lambda: tmp_path)})
    assert run.latest() is None


def test_processes_that_do_not_write_leave_no_trace(tmp_path: Path) -> None:
    run = RunFolder.open(tmp_path / "run", "force", Toy(), "data", writes=False)
    run.log(1, {"loss": 1.0})
    run.save(1, {"model": Net(8)}, {})
    run.finish(1, {"model": Net(8)})
    assert not (tmp_path / "run").exists()


def test_what_is_not_finite_is_logged_as_null(tmp_path: Path) -> None:
    run = RunFolder.open(tmp_path / "run", "force", Toy(), "data")
    run.log(1, {"r2": float("nan"), "loss": 2.0, "what": "text"})
    assert _losses(tmp_path / "run") == [{"step": 1, "r2": None, "loss": 2.0, "what": "text"}]
