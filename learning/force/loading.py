"""Trained force models, opened by folder, web address or name."""

import os
from pathlib import Path

import torch

from learning.force.closed_form import ClosedFormModel, ClosedFormSettings
from learning.force.folder import model_folder
from learning.force.model import (
    CLOSED_FORM,
    KIND,
    ForceModel,
    ForceNetworkSettings,
    InputSettings,
    new_force_model,
)
from learning.plugins import load_plugin, plugin_names
from learning.training.checkpoint import read_config, read_model_folder


def load_force_model(
    name_or_folder: str | os.PathLike[str], device: str | torch.device = "cpu"
) -> ForceModel:
    """Load a trained model, in evaluation mode: ours, or one of another package.

    It is the folder of a finished run, its web address, `demo`, or the name of an installed
    package's model that needs no folder.

    Raises:
        LearningError: Not such a folder, a model of another kind, or weights that do not fit.
    """
    name, offered = os.fspath(name_or_folder), plugin_names()
    if name in offered:
        return _foreign(name, None, device)
    folder = model_folder(name)
    if (kind := read_config(folder).kind) != KIND and kind in offered:
        return _foreign(kind, folder, device)
    stored = read_model_folder(folder, KIND)
    if CLOSED_FORM in stored.config.settings:
        closed = stored.settings(ClosedFormSettings, CLOSED_FORM)
        return stored.load(ClosedFormModel(closed, stored.settings(InputSettings, "input")), device)
    model = new_force_model(
        stored.config.settings.get("plugin"),
        stored.settings(ForceNetworkSettings, "network"),
        stored.settings(InputSettings, "input"),
    )
    return stored.load(model, device)


def _foreign(name: str, folder: Path | None, device: str | torch.device) -> ForceModel:
    model: ForceModel = load_plugin(name, ForceModel, folder=folder, device=str(device))
    return model.to(device).eval()
