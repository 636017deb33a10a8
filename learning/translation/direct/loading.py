"""A trained direct translator from its folder."""

from __future__ import annotations

from pathlib import Path

import torch

from learning.training.model_folder import read_model_folder
from learning.translation.direct.network import DirectNetwork
from learning.translation.direct.settings import DirectSettings
from learning.translation.direct.translator import DirectTranslator

KIND = "direct"
"""What its folder says that it is."""

_HASH_SHOWN = 8


def load_network(
    folder: Path, device: torch.device | str = "cpu"
) -> tuple[DirectNetwork, DirectSettings]:
    """Return the network in a folder, and the settings it was trained with.

    Args:
        folder: A finished run of `train-direct`, or one of its checkpoints.
        device: Where it computes.

    Raises:
        LearningError: No such folder, a model of another kind, or weights that do not fit.
    """
    found = read_model_folder(folder, KIND)
    settings = found.settings(DirectSettings)
    network = DirectNetwork(**settings.structure)
    found.load(network)
    return network.to(device).eval(), settings


def load(folder: Path, device: torch.device | str = "cpu") -> DirectTranslator:
    """Return the translator in a folder.

    Raises:
        LearningError: As `load_network`.
    """
    network, _ = load_network(folder, device)
    mark = read_model_folder(folder, KIND).hash()[:_HASH_SHOWN]
    return DirectTranslator(network, f"{KIND}[{mark}]")
