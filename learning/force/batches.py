"""The frames and forces of a training step, taken out of presses in memory."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learning.data.presses import Presses
from learning.errors import LearningError
from learning.force.inputs import prepare
from learning.force.sequences import Sequences
from learning.force.settings import InputSettings


def require_form(presses: Presses, inputs: InputSettings) -> None:
    """Refuse presses of another form than a model takes.

    Raises:
        LearningError: Images where marker fields are wanted, or the other way round.
    """
    if presses.form != inputs.stored_form:
        raise LearningError(
            f"presses of {presses.sensor}: found {presses.form}; allowed: {inputs.stored_form}, as "
            f"the model's input is {inputs.form}"
        )


def prepared_rows(presses: Presses, rows: Tensor, inputs: InputSettings) -> Tensor:
    """Return frames (n, planes, side, side) of presses as the network takes them.

    Args:
        presses: Images or marker fields.
        rows: Which of their frames (n,), on the device of the presses.
        inputs: What is to be shown.
    """
    references = presses.references[presses.reference[rows]] if inputs.needs_reference else None
    return prepare(presses.images[rows], references, inputs)


def frames_of(
    groups: Sequence[Presses], sequences: Sequences, inputs: InputSettings, device: torch.device
) -> Tensor:
    """Return the prepared frames (b, s, planes, side, side) of a step, mirrored where it says so.

    Args:
        groups: The presses of each sensor.
        sequences: Which frames.
        inputs: What is to be shown.
        device: Where they are to lie.
    """
    shown = []
    for sensor, rows in zip(sequences.sensor, sequences.rows, strict=True):
        presses = groups[sensor]
        wanted = torch.from_numpy(rows).to(presses.device)
        shown.append(prepared_rows(presses, wanted, inputs).to(device))
    return mirrored(torch.stack(shown), sequences.flips, inputs)


def mirrored(frames: Tensor, flips: NDArray[np.bool_], inputs: InputSettings) -> Tensor:
    """Return prepared frames (..., b, s, planes, h, w), columns and rows mirrored where asked.

    Args:
        frames: Of sequences.
        flips: Whether columns and rows of each sequence are mirrored (b, 2).
        inputs: What the frames show.
    """
    for plane, axis in enumerate((-1, -2)):
        if not flips[:, plane].any():
            continue
        chosen = torch.from_numpy(flips[:, plane]).to(frames.device)[:, None, None, None, None]
        other = frames.flip(axis)
        if inputs.form == "field":
            sign = torch.ones(frames.shape[-3], device=frames.device)
            sign[plane] = -1.0
            other = other * sign[:, None, None]
        frames = torch.where(chosen, other, frames)
    return frames


def signs(flips: NDArray[np.bool_], device: torch.device) -> Tensor:
    """Return what forces (..., b, s, 3) of mirrored sequences are multiplied with (b, 1, 3).

    Args:
        flips: Whether columns and rows of each sequence are mirrored (b, 2), and the shear with
            them.
        device: Where it is to lie.
    """
    sign = torch.ones(len(flips), 1, 3)
    sign[:, 0, :2] = torch.where(torch.from_numpy(flips), -1.0, 1.0)
    return sign.to(device)


def forces_of(labels: Sequence[Tensor], sequences: Sequences, device: torch.device) -> Tensor:
    """Return the forces (b, s, 3) N of a step; mirroring an image mirrors the shear.

    Args:
        labels: Forces (N, 3) N of the frames of each sensor.
        sequences: Which frames.
        device: Where they are to lie.
    """
    wanted = [
        labels[sensor][torch.from_numpy(rows).to(labels[sensor].device)].to(device)
        for sensor, rows in zip(sequences.sensor, sequences.rows, strict=True)
    ]
    return torch.stack(wanted) * signs(sequences.flips, device)


def error(predicted: Tensor, wanted: Tensor, lengths: Sequence[int] | None) -> Tensor:
    """Return the mean absolute error of forces (b, s, 3) over frames that count (eq. 5).

    Args:
        predicted: As shares of the box of forces.
        wanted: Likewise.
        lengths: Frames of each sequence that count (b,); None: all.
    """
    difference = (predicted - wanted).abs()
    if lengths is None:
        return difference.mean()
    counts = torch.tensor(lengths, device=difference.device)
    inside = torch.arange(difference.shape[1], device=difference.device) < counts[:, None]
    return (difference * inside[..., None]).sum() / (counts.sum() * difference.shape[2])
