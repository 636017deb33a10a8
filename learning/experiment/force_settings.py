"""How the force models of an experiment are trained."""

from __future__ import annotations

from dataclasses import replace

import torch

from learning.errors import LearningError
from learning.experiment.parts import frames_of_a_press
from learning.experiment.settings import ExperimentSettings
from learning.force.settings import PRESETS, ForceSettings
from learning.settings import read_settings
from recorder import MarkerArchive


def force_settings(
    experiment: ExperimentSettings,
    archive: MarkerArchive,
    device: torch.device,
    *,
    tuning: bool = False,
) -> ForceSettings:
    """Return how force models learn.

    Args:
        experiment: Names a preset and what is changed of it.
        archive: What they learn from.
        device: Where they do.
        tuning: Whether they go on from the source's model on translated frames.

    Raises:
        LearningError: A preset or a value that is none, or a model that sees no images.
    """
    changed = experiment.force.set + (experiment.fine_tuning if tuning else ())
    settings = read_settings(
        ForceSettings, PRESETS, experiment.force.preset, (*changed, f"launch.device={device.type}")
    )
    if settings.input.stored_form != "images":
        raise LearningError(
            f"force: found {experiment.force.preset}, which sees marker fields; allowed: a model "
            "that sees images, which is what is translated"
        )
    if experiment.memory:
        return settings
    # A step sees as many frames as with whole presses.
    batch = settings.sequences.batch * frames_of_a_press(archive)
    return replace(settings, sequences=replace(settings.sequences, batch=batch))
