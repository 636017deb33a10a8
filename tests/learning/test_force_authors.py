"""The authors' force models open, and predict as their network does."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from learning.errors import LearningError
from learning.force.authors import import_force_weights
from learning.force.model import load_force_model, prepare
from tactile.__main__ import main

# Widths of a small network of the same structure: those of theirs are 64, 96, 128; 128; 256, 512.
WIDTHS, MEMORY, TAIL = (8, 12, 16), 16, (20, 24)


def their_weights() -> dict[str, Tensor]:
    """Return random tensors under the names of the authors' checkpoints."""
    random = torch.Generator().manual_seed(0)
    state: dict[str, Tensor] = {}

    def conv(name: str, before: int, after: int, side: int) -> None:
        shape = (after, before, side, side)
        state[f"{name}.weight"] = torch.randn(shape, generator=random) / (before**0.5 * side)
        state[f"{name}.bias"] = 0.1 * torch.randn(after, generator=random)

    def batch(name: str, planes: int) -> None:
        for kind in ("weight", "running_var"):
            state[f"{name}.{kind}"] = 0.5 + torch.rand(planes, generator=random)
        for kind in ("bias", "running_mean"):
            state[f"{name}.{kind}"] = 0.1 * torch.randn(planes, generator=random)
        state[f"{name}.num_batches_tracked"] = torch.tensor(7)

    conv("base_network.conv1", 3, WIDTHS[0], 7)
    before = WIDTHS[0]
    for stage, width in enumerate(WIDTHS, 1):
        for block in range(2):
            name = f"base_network.layer{stage}.{block}"
            conv(f"{name}.conv1", before, width, 3)
            conv(f"{name}.conv2", width, width, 3)
            if stage > 1 and not block:
                conv(f"{name}.downsample.0", before, width, 1)
            before = width
    conv("base_network.conv2", before, before, 1)
    for gate in ("convz", "convr", "convq"):
        conv(f"convgru.layers.0.{gate}", MEMORY + before, MEMORY, 3)
    before = MEMORY
    for block, width in enumerate(TAIL):
        name = f"post_processing.{block}"
        conv(f"{name}.conv1", before, width, 3)
        conv(f"{name}.conv2", width, width, 3)
        conv(f"{name}.downsample.0", before, width, 1)
        for norm in ("norm1", "norm2", "norm3"):
            batch(f"{name}.{norm}", width)
        # One norm under two names.
        for key in [key for key in state if key.startswith(f"{name}.norm3.")]:
            state[key.replace("norm3", "downsample.1")] = state[key]
        before = width
    state["reg_layer.0.weight"] = torch.randn(3, before, generator=random)
    state["reg_layer.0.bias"] = torch.randn(3, generator=random)
    return state


def their_forces(state: dict[str, Tensor], frames: Tensor) -> Tensor:
    """Return the normalised forces (s, 3) of frames (s, 3, 256, 256), computed step by step."""

    def conv(name: str, x: Tensor, stride: int = 1, padding: int = 1) -> Tensor:
        weight, bias = state[f"{name}.weight"], state[f"{name}.bias"]
        return functional.conv2d(x, weight, bias, stride, padding)

    def norm(name: str, x: Tensor) -> Tensor:
        if f"{name}.weight" not in state:
            return functional.instance_norm(x)
        values = [state[f"{name}.{kind}"] for kind in ("running_mean", "running_var")]
        return functional.batch_norm(x, *values, state[f"{name}.weight"], state[f"{name}.bias"])

    def block(name: str, x: Tensor, stride: int) -> Tensor:
        y = norm(f"{name}.norm1", conv(f"{name}.conv1", x, stride)).relu()
        y = norm(f"{name}.norm2", conv(f"{name}.conv2", y)).relu()
        if stride > 1:
            x = norm(f"{name}.norm3", conv(f"{name}.downsample.0", x, stride, 0))
        return (x + y).relu()

    x = functional.instance_norm(conv("base_network.conv1", frames, 2, 3)).relu()
    for stage in (1, 2, 3):
        x = block(f"base_network.layer{stage}.0", x, 1 if stage == 1 else 2)
        x = block(f"base_network.layer{stage}.1", x, 1)
    x = conv("base_network.conv2", x, padding=0)
    hidden, found = torch.zeros(1, MEMORY, *x.shape[2:]), []
    for frame in x[:, None]:
        both = torch.cat([hidden, frame], 1)
        update = conv("convgru.layers.0.convz", both).sigmoid()
        reset = conv("convgru.layers.0.convr", both).sigmoid()
        new = conv("convgru.layers.0.convq", torch.cat([reset * hidden, frame], 1)).tanh()
        hidden = (1 - update) * hidden + update * new
        y = block("post_processing.1", block("post_processing.0", hidden, 2), 2)
        y = y.mean(dim=(2, 3)) @ state["reg_layer.0.weight"].T + state["reg_layer.0.bias"]
        found.append(y.sigmoid())
    return torch.cat(found)


@torch.no_grad()
def test_a_model_of_the_authors_predicts_what_their_network_computes(tmp_path: Path) -> None:
    state = their_weights()
    torch.save(state, tmp_path / "epoch_20.pth")
    command = ["import", str(tmp_path / "epoch_20.pth"), "--out", str(tmp_path / "run")]
    assert main(command) == 0
    model = load_force_model(tmp_path / "run")
    images = (torch.rand(3, 256, 256, generator=torch.Generator().manual_seed(1)) > 0.5).byte()
    frames = prepare(images * 255, None, model.inputs)
    found, _ = model(frames[None])
    torch.testing.assert_close(found[0], their_forces(state, frames), rtol=0, atol=1e-5)
    assert model.denormalise(torch.zeros(3)).tolist() == [-5.0, -5.0, -20.0]
    # Again: the same file fits the folder, another does not.
    import_force_weights(tmp_path / "epoch_20.pth", tmp_path / "run")
    del state["post_processing.0.conv1.bias"]
    torch.save(state, tmp_path / "less.pth")
    with pytest.raises(LearningError, match=r"missing tail\.0\.branch\.0\.bias"):
        import_force_weights(tmp_path / "less.pth", tmp_path / "other")
    torch.save({"a": torch.zeros(1)}, tmp_path / "wrong.pth")
    with pytest.raises(LearningError, match="a force model of the authors' code"):
        import_force_weights(tmp_path / "wrong.pth", tmp_path / "other")
    (tmp_path / "text.pth").write_text("x")
    with pytest.raises(LearningError, match="is no file of weights"):
        import_force_weights(tmp_path / "text.pth", tmp_path / "other")
