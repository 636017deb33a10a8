"""Open a translator by name or from the folder of a training run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from learning.errors import LearningError
from learning.translation.translator import FLOW, Translator

if TYPE_CHECKING:
    import torch

# Kinds of trained translators, as named in the folders of their runs.
LEARNED = ("field", "direct", "diffusion")


def load_translator(name_or_folder: str | Path, device: torch.device | str = "cpu") -> Translator:
    """Return a translator.

    Args:
        name_or_folder: `flow`, or the folder of a finished training run.
        device: Device on which a trained translator computes.

    Raises:
        LearningError: The folder does not exist or holds no translator.
    """
    if str(name_or_folder) == FLOW:
        from learning.translation.flow import FlowTranslator

        return FlowTranslator()
    from learning.training.checkpoint import CONFIG, read_config

    folder = Path(name_or_folder)
    kind = read_config(folder).kind
    # Imported on demand: diffusion needs libraries that the others do not.
    if kind == "field":
        from learning.translation import field

        return field.load(folder, device)
    if kind == "direct":
        from learning.translation import direct

        return direct.load(folder, device)
    if kind == "diffusion":
        from learning.translation import diffusion

        return diffusion.load(folder, device)
    raise LearningError(
        f"{folder / CONFIG}: found kind {kind!r}; allowed: {', '.join(LEARNED)}, or {FLOW!r} "
        "in place of a folder"
    )
