"""Open a translator by name or from the folder of a training run."""

import hashlib
from importlib import import_module
from pathlib import Path

import torch

from learning.errors import LearningError
from learning.plugins import load_plugin, plugin_identity, plugin_names
from learning.training.checkpoint import CONFIG, read_config, read_model_folder
from learning.translation.translator import FLOW, Translator

# Modules of our trained translators, by kind; imported on demand, as one needs further libraries.
TRAINED = {
    "field": "learning.translation.field.translator",
    "diffusion": "learning.translation.diffusion.translator",
}


def load_translator(name_or_folder: str | Path, device: torch.device | str = "cpu") -> Translator:
    """Return a translator: ours, or one of another package (`learning.plugins`).

    It is `flow`, the name of an installed translator that needs no folder, or the folder of a
    finished training run.

    Raises:
        LearningError: The folder does not exist or holds no translator.
    """
    name = str(name_or_folder)
    if name == FLOW:
        from learning.translation.flow import FlowTranslator

        return FlowTranslator()
    if name in plugin_names():
        return _foreign(name, None, device)
    folder = Path(name_or_folder)
    if not folder.exists():
        raise LearningError(
            f"--model: found {name!r}; allowed: {', '.join((FLOW, *plugin_names()))}, or the "
            "folder of a training run"
        )
    kind = read_config(folder).kind
    if kind in TRAINED:
        translator: Translator = import_module(TRAINED[kind]).load(folder, device)
        return translator
    if kind not in (offered := plugin_names()):
        raise LearningError(
            f"{folder / CONFIG}: found kind {kind!r}; allowed: {', '.join((*TRAINED, *offered))}, "
            f"or {FLOW!r} in place of a folder"
        )
    return _foreign(kind, folder, device)


def _foreign(name: str, folder: Path | None, device: torch.device | str) -> Translator:
    translator: Translator = load_plugin(name, Translator, folder=folder, device=str(device))
    return translator


def hash_of(name_or_folder: str | Path) -> str:
    """Return the SHA-256 of a model's weights; of what it is if it has no folder."""
    name = str(name_or_folder)
    if name == FLOW:
        return hashlib.sha256(FLOW.encode()).hexdigest()
    if name in plugin_names():
        return hashlib.sha256(plugin_identity(name).encode()).hexdigest()
    return read_model_folder(Path(name_or_folder)).hash()
