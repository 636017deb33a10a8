"""The authors' force models open, and predict as their network does."""

from pathlib import Path

import pytest
import torch
from support.authors_net import FULL, SMALL, Theirs

from learning.errors import LearningError
from learning.force.authors import import_force_weights
from learning.force.loading import load_force_model
from learning.force.model import ForceModel, prepare
from learning.force.train import read_force_settings
from tactile.__main__ import main


@torch.no_grad()
def test_their_preset_has_their_network_to_the_weight(tmp_path: Path) -> None:
    theirs = Theirs(*FULL)
    settings = read_force_settings("authors_code")
    model = ForceModel(settings.network, settings.input)
    for network in (theirs, model):
        assert sum(each.numel() for each in network.parameters()) == 6_531_427
    torch.save(theirs.state_dict(), tmp_path / "epoch_40.pth")
    read = import_force_weights(tmp_path / "epoch_40.pth", tmp_path / "run")
    assert read.network == settings.network
    # Sums of all weights: none is left over, and none is read twice.
    sums = [sum(float(each.double().sum()) for each in net.parameters()) for net in (theirs, read)]
    assert sums[0] == pytest.approx(sums[1])


@torch.no_grad()
def test_a_model_of_the_authors_predicts_what_their_network_computes(tmp_path: Path) -> None:
    torch.manual_seed(0)
    theirs = Theirs(*SMALL).eval()
    state = theirs.state_dict()
    torch.save(state, tmp_path / "epoch_20.pth")
    command = ["import", str(tmp_path / "epoch_20.pth"), "--out", str(tmp_path / "run")]
    assert main(command) == 0
    model = load_force_model(tmp_path / "run")
    images = (torch.rand(3, 256, 256, generator=torch.Generator().manual_seed(1)) > 0.5).byte()
    frames = prepare(images * 255, None, model.inputs)
    forces, _ = model(frames[None])
    torch.testing.assert_close(forces[0], theirs(frames), rtol=0, atol=1e-5)
    assert model.denormalise(torch.zeros(3)).tolist() == [-5.0, -5.0, -20.0]
    # Again: the same file fits the folder, another does not.
    import_force_weights(tmp_path / "epoch_20.pth", tmp_path / "run")
    torch.save({**state, "reg_layer.2.bias": torch.zeros(1)}, tmp_path / "more.pth")
    del state["post_processing.0.conv1.bias"]
    torch.save(state, tmp_path / "less.pth")
    torch.save({"a": torch.zeros(1)}, tmp_path / "wrong.pth")
    (tmp_path / "text.pth").write_text("x")
    for name, message in (
        ("less.pth", r"missing tail\.0\.branch\.0\.bias"),
        ("more.pth", r"unexpected reg_layer\.2\.bias"),
        ("wrong.pth", "a force model of the authors' code"),
        ("text.pth", "is no file of weights"),
    ):
        with pytest.raises(LearningError, match=message):
            import_force_weights(tmp_path / name, tmp_path / "other")
