"""Publish a trained force model: weights, settings, ONNX and a card, in a folder for others."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from learning.errors import LearningError
from learning.force.export import export_onnx
from learning.force.intervals import FILE
from learning.force.model import load_force_model
from recorder import models


def publish(
    folder: Path, place: Path, name: str, card: str, *, licence: str = "Apache-2.0"
) -> models.PublishedModel:
    """Copy a force model to a place that `tactile models get` takes it from, and list it there.

    Args:
        folder: Folder of a trained force model.
        place: Folder with the index; it is made.
        name: Name to publish it by.
        card: Text with data, split, seeds, errors and licence, in Markdown. The list shows its
            first line that is no heading.
        licence: SPDX name.

    Raises:
        LearningError: The card has no text, or the folder is no force model.
        SessionError: The name is not plain, or there is such a model.
    """
    text = next((line for line in card.splitlines() if line and not line.startswith("#")), "")
    if not text:
        raise LearningError("card: found no text; allowed: a first line that says what it gives")
    model = load_force_model(folder)
    with tempfile.TemporaryDirectory() as scratch:
        part = Path(scratch)
        for file in ("model.safetensors", "config.yaml", FILE):
            if (folder / file).is_file():
                shutil.copy(folder / file, part / file)
        export_onnx(model, part / "model.onnx")
        (part / "card.md").write_text(card, encoding="utf-8")
        return models.add(part, place, name, licence=licence, text=text)
