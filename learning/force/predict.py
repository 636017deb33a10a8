"""Prediction of the forces of presses by a trained force model."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learning.config import read_settings
from learning.data.presses import AUTHORS, Presses
from learning.force.data import prepared_rows, require_form
from learning.force.model import PRESETS, ForceModel, ForceSettings
from learning.training.checkpoint import read_model_folder
from learning.training.run import seed_torch

# Kind of a force model's folder.
KIND = "force"
# Number of presses predicted at once, by type of device.
_TOGETHER = {"cpu": 8, "cuda": 128}

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True, eq=False)
class ForcePredictor:
    """A trained force model."""

    model: ForceModel
    settings: ForceSettings

    @property
    def device(self) -> torch.device:
        """Device of the model."""
        return self.model.low.device

    def predict(
        self, presses: Presses, *, progress: Progress = lambda done, total: None
    ) -> NDArray[np.float64]:
        """Return forces (N, 3) N of all frames; every press starts from the initial state.

        Args:
            presses: Images, or marker fields if the model takes those.
            progress: Called with the number of frames done and the total.

        Raises:
            LearningError: The presses have another form than the model takes.
        """
        normalised = predicted_normalised(self.model, presses, progress=progress)
        forces: NDArray[np.float64] = self.model.denormalise(normalised).double().cpu().numpy()
        return forces


@torch.no_grad()
def predicted_normalised(
    model: ForceModel, presses: Presses, *, progress: Progress = lambda done, total: None
) -> Tensor:
    """Return a model's outputs (N, 3), 0 to 1, for all frames, on its device.

    Presses are processed in parallel frame by frame, so that memory holds one frame of each.

    Raises:
        LearningError: The presses have another form than the model takes.
    """
    require_form(presses, model.inputs)
    training, device = model.training, model.low.device
    starts, lengths = presses.starts[:-1], presses.starts.diff()
    predicted = torch.zeros(presses.frames, 3, device=device)
    done = 0
    model.eval()
    for group in lengths.argsort(descending=True, stable=True).split(_TOGETHER[device.type]):
        state = model.untouched(len(group))
        for time in range(int(lengths[group].max())):
            # Sorted by descending length, so finished presses are at the end.
            running = group[lengths[group] > time]
            rows = (starts[running] + time).to(presses.device)
            frames = prepared_rows(presses, rows, model.inputs).to(device)
            normalised, state = model.step(frames, state[: len(running)])
            predicted[rows.to(device)] = normalised
            done += len(running)
            progress(done, presses.frames)
    model.train(training)
    return predicted


def load_force_model(
    folder: str | os.PathLike[str], device: str | torch.device = "cpu"
) -> ForcePredictor:
    """Load the model of a finished run.

    Raises:
        LearningError: Not such a folder, a model of another kind, or weights that do not fit.
    """
    found = read_model_folder(Path(folder), KIND)
    settings = found.settings(ForceSettings)
    model = ForceModel(settings.network, settings.input)
    found.load(model)
    return ForcePredictor(model.to(torch.device(device)).eval(), settings)


def untrained(preset: str, device: str | torch.device = "cpu") -> ForcePredictor:
    """Return a model of a preset with random weights and the authors' force range.

    Raises:
        LearningError: The preset does not exist.
    """
    settings = read_settings(ForceSettings, PRESETS, preset)
    seed_torch(settings.seed, "force", "weights")
    model = ForceModel(settings.network, settings.input)
    model.set_range(AUTHORS)
    return ForcePredictor(model.to(torch.device(device)).eval(), settings)
