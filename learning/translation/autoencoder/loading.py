"""A trained autoencoder from its folder."""

from __future__ import annotations

from pathlib import Path

import torch

from learning.training.model_folder import read_model_folder
from learning.translation.autoencoder.network import Autoencoder
from learning.translation.autoencoder.settings import AutoencoderSettings

KIND = "autoencoder"
"""What its folder says that it is."""


def load_autoencoder(folder: Path, device: torch.device | str = "cpu") -> Autoencoder:
    """Return the autoencoder in a folder, for use.

    Args:
        folder: A finished run of `train-autoencoder`, or one of its checkpoints.
        device: Where it computes.

    Raises:
        LearningError: No such folder, a model of another kind, or weights that do not fit.
    """
    found = read_model_folder(folder, KIND)
    settings = found.settings(AutoencoderSettings)
    network = Autoencoder(settings.widths, settings.latent)
    found.load(network)
    return network.to(device).eval()
