"""Reads a trained field model back, ready to translate."""

from __future__ import annotations

from pathlib import Path

import torch

from learning.training.model_folder import read_model_folder
from learning.translation.field.model import FieldModel
from learning.translation.field.settings import FieldSettings
from learning.translation.field.translator import FieldTranslator

KIND = "field"
"""Of model, in `config.yaml`."""


def load(folder: Path, device: torch.device | str = "cpu") -> FieldTranslator:
    """Return the translator in the folder of a finished training run.

    Args:
        folder: Of the run, or of one of its checkpoints.
        device: Where it computes.

    Raises:
        LearningError: No model, one of another kind, or weights of another network.
    """
    found = read_model_folder(Path(folder), KIND)
    model = FieldModel(found.settings(FieldSettings))
    found.load(model)
    name = f"{KIND}[{found.hash()[:8]}]"
    return FieldTranslator(name, model.to(device).eval())
