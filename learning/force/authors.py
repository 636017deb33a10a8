"""Import of the authors' force models, with tensors renamed to the names used here.

Their `epoch_N.pth` holds the state of one network and nothing else: that of preset `authors_code`,
with three separate convolutions for the gates, two of which are one here. The file contains only
tensors, so no code in it is run.
"""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from learning.config import read_settings
from learning.data.presses import AUTHORS
from learning.errors import LearningError
from learning.force.model import KIND, ForceModel
from learning.force.train import PRESETS, ForceModelSettings
from learning.training.checkpoint import load_weights, read_tensors, weights_hash
from learning.training.run import RunFolder

# Our names of their blocks, of the convolutions and norms in one, and of all parts.
_BLOCKS = {
    **{
        f"base_network.layer{stage + 1}.{block}.": f"encoder.{3 + 2 * stage + block}."
        for stage in range(3)
        for block in range(2)
    },
    "post_processing.0.": "tail.0.",
    "post_processing.1.": "tail.1.",
}
_BLOCK = {
    "conv1.": "branch.0.",
    "norm1.": "branch.1.",
    "conv2.": "branch.3.",
    "norm2.": "branch.4.",
    "downsample.0.": "skip.0.",
    "downsample.1.": "skip.1.",
}
_PARTS = {
    "base_network.conv1.": "encoder.0.",
    "base_network.conv2.": "encoder.9.",
    "convgru.layers.0.convq.": "memory.candidate.",
    "reg_layer.0.": "head.",
    **{block + part: ours + own for block, ours in _BLOCKS.items() for part, own in _BLOCK.items()},
}
_GATES = tuple(f"convgru.layers.0.{name}." for name in ("convz", "convr"))


def import_force_weights(file: Path, out: Path, *, marker_value: float = 1.0) -> ForceModel:
    """Write a run folder with one of the authors' force models, a `.pth` file, and return it.

    `marker_value` is the value of a marker in their training images: 1, or 1/255 in their code for
    homogeneous and material sensors.
    """
    tensors = read_tensors(file)
    changes = [f"input.marker_value={marker_value!r}", *_widths(file, tensors)]
    settings = read_settings(ForceModelSettings, PRESETS, "authors_code", changes)
    model = ForceModel(settings.network, settings.input)
    model.set_range(AUTHORS)
    box = {name: getattr(model, name) for name in ("low", "high")}
    load_weights(model, {**_renamed(tensors), **box}, str(file))
    data = f"{file.name} {weights_hash(file)}"
    run = RunFolder.open(out, KIND, settings, data)
    if not run.finished:
        run.finish(0, {"model": model})
    return model.eval()


def _widths(file: Path, tensors: Mapping[str, Tensor]) -> list[str]:
    """Return the widths of a model, from the shapes of its tensors, as overrides of settings."""

    def width(name: str) -> int:
        if name not in tensors:
            raise LearningError(
                f"{file}: found no tensor {name}; allowed: a force model of the authors' code"
            )
        return int(tensors[name].shape[0])

    encoder = [width(f"base_network.layer{stage}.0.conv1.weight") for stage in (1, 2, 3)]
    tail = [width(f"post_processing.{block}.conv1.weight") for block in (0, 1)]
    memory = width("convgru.layers.0.convq.weight")
    return [f"network.encoder={encoder}", f"network.memory={memory}", f"network.tail={tail}"]


def _renamed(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors under our names; unknown ones keep theirs and are rejected later."""
    renamed: dict[str, Tensor] = {}
    for name, each in tensors.items():
        if name.startswith(_GATES) or ".norm3." in name:  # norm3 is downsample.1 again
            continue
        renamed[_name(name)] = each
    for kind in ("weight", "bias"):
        gates = [tensors[f"{gate}{kind}"] for gate in _GATES if f"{gate}{kind}" in tensors]
        if gates:
            renamed[f"memory.gates.{kind}"] = torch.cat(gates)
    return renamed


def _name(name: str) -> str:
    for theirs, ours in _PARTS.items():
        if name.startswith(theirs):
            return ours + name.removeprefix(theirs)
    return name
