"""Frames and forces of training steps, selected from presses in memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learning.data.presses import AUTHORS, ForceRange, Presses
from learning.errors import LearningError
from learning.force.model import ForceSettings, InputSettings, SequenceSettings, prepare
from learning.training.run import generator

# Selection of a training step's frames: a pure function of seed, stage, epoch and step.

# Length of the shortest sequence (the paper, Methods).
SHORTEST = 2


@dataclass(frozen=True, slots=True)
class Sequences:
    """The sequences of one step, on one process."""

    sensor: NDArray[np.int64]
    """Index of the sensor of each sequence (b,)."""
    rows: NDArray[np.int64]
    """Frame indices (b, s) in that sensor's presses; a shorter sequence repeats its last frame."""
    lengths: tuple[int, ...]
    """Number of valid frames of each sequence (b,)."""
    flips: NDArray[np.bool_]
    """True where columns and rows are mirrored (b, 2)."""


@dataclass(frozen=True, slots=True)
class Epoch:
    """One pass over the presses of some sensors."""

    strings: tuple[tuple[int, NDArray[np.int64]], ...]
    """Sensor and presses of each sequence, in training order."""
    starts: tuple[NDArray[np.int64], ...]
    """Frames of press p of a sensor are starts[p]:starts[p + 1]."""
    settings: SequenceSettings
    seed: int
    number: int
    """Counts epochs over all stages."""

    def steps(self, ranks: int) -> int:
        """Return the number of steps of the pass with `ranks` processes."""
        return -(-len(self.strings) // (self.settings.batch * ranks))

    def sequences(self, step: int, rank: int = 0, ranks: int = 1) -> Sequences:
        """Return the sequences of a step; the last is filled up from the start of the order."""
        batch = self.settings.batch
        first = (step * ranks + rank) * batch
        chosen = [self.strings[place % len(self.strings)] for place in range(first, first + batch)]
        frames = [self._frames(sensor, presses) for sensor, presses in chosen]
        random = generator(self.seed, "force", "sequences", self.number, step, rank)
        longest = max(map(len, frames))
        if self.settings.lengths == "random":
            longest = int(random.integers(min(SHORTEST, longest), longest, endpoint=True))
        lengths = tuple(min(longest, len(each)) for each in frames)
        rows = np.stack([each[np.minimum(np.arange(longest), len(each) - 1)] for each in frames])
        flips = random.random((batch, 2)) < 0.5
        return Sequences(
            np.array([sensor for sensor, _ in chosen]),
            rows,
            lengths,
            flips if self.settings.flips else np.zeros_like(flips),
        )

    def _frames(self, sensor: int, presses: NDArray[np.int64]) -> NDArray[np.int64]:
        starts = self.starts[sensor]
        return np.concatenate([np.arange(starts[press], starts[press + 1]) for press in presses])


def epoch(
    starts: Sequence[NDArray[np.int64]],
    sensors: Sequence[int],
    settings: SequenceSettings,
    seed: int,
    number: int,
) -> Epoch:
    """Return one pass over the presses of `sensors` in random order.

    Args:
        starts: Starts for every sensor (P + 1,): frames of press p are starts[p]:starts[p + 1].
        sensors: Indices of the sensors to train on.
        settings: Number of presses per sequence; leftover presses are skipped in this pass.
        seed: Seed of the whole training.
        number: Counts epochs over all stages.
    """
    random = generator(seed, "force", "epoch", number)
    strings = []
    for sensor in sensors:
        order = random.permutation(len(starts[sensor]) - 1).astype(np.int64)
        together = min(settings.presses, len(order))
        whole = order[: len(order) - len(order) % together]
        strings += [(sensor, presses) for presses in whole.reshape(-1, together)]
    shuffled = [strings[place] for place in random.permutation(len(strings))]
    return Epoch(tuple(shuffled), tuple(starts), settings, seed, number)


def require_form(presses: Presses, inputs: InputSettings) -> None:
    """Reject presses of another form than a model takes.

    Raises:
        LearningError: Images instead of marker fields, or vice versa.
    """
    if presses.form != inputs.stored_form:
        raise LearningError(
            f"presses of {presses.sensor}: found {presses.form}; allowed: {inputs.stored_form}, as "
            f"the model's input is {inputs.form}"
        )


def prepared_rows(presses: Presses, rows: Tensor, inputs: InputSettings) -> Tensor:
    """Return frames (n, planes, side, side) of presses as network inputs.

    Args:
        presses: Images or marker fields.
        rows: Frame indices (n,), on the device of the presses.
        inputs: Settings of the network input.
    """
    references = presses.references[presses.reference[rows]] if inputs.needs_reference else None
    return prepare(presses.images[rows], references, inputs)


def frames_of(
    groups: Sequence[Presses], sequences: Sequences, inputs: InputSettings, device: torch.device
) -> Tensor:
    """Return the prepared and mirrored frames (b, s, planes, side, side) of a step.

    Args:
        groups: Presses of each sensor.
        sequences: Sequences of the step.
        inputs: Settings of the network input.
        device: Device of the result.
    """
    shown = []
    for sensor, rows in zip(sequences.sensor, sequences.rows, strict=True):
        presses = groups[sensor]
        wanted = torch.from_numpy(rows).to(presses.device)
        shown.append(prepared_rows(presses, wanted, inputs).to(device))
    return mirrored(torch.stack(shown), sequences.flips, inputs)


def mirrored(frames: Tensor, flips: NDArray[np.bool_], inputs: InputSettings) -> Tensor:
    """Return prepared frames (..., b, s, planes, h, w), mirrored where requested.

    Args:
        frames: Frames of sequences.
        flips: True to mirror columns and rows of each sequence (b, 2).
        inputs: Settings of the network input.
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
    """Return the signs (b, 1, 3) for forces (..., b, s, 3) of mirrored sequences.

    Args:
        flips: True where columns and rows of each sequence are mirrored (b, 2), together with the
            shear.
        device: Device of the result.
    """
    sign = torch.ones(len(flips), 1, 3)
    sign[:, 0, :2] = torch.where(torch.from_numpy(flips), -1.0, 1.0)
    return sign.to(device)


def forces_of(labels: Sequence[Tensor], sequences: Sequences, device: torch.device) -> Tensor:
    """Return the forces (b, s, 3) N of a step; mirroring an image mirrors the shear.

    Args:
        labels: Forces (N, 3) N of the frames of each sensor.
        sequences: Sequences of the step.
        device: Device of the result.
    """
    wanted = [
        labels[sensor][torch.from_numpy(rows).to(labels[sensor].device)].to(device)
        for sensor, rows in zip(sequences.sensor, sequences.rows, strict=True)
    ]
    return torch.stack(wanted) * signs(sequences.flips, device)


def error(predicted: Tensor, wanted: Tensor, lengths: Sequence[int] | None) -> Tensor:
    """Return the mean absolute error of forces (b, s, 3) over valid frames (eq. 5).

    Args:
        predicted: Predicted forces, normalised to the force range.
        wanted: True forces, likewise.
        lengths: Number of valid frames of each sequence (b,); None: all.
    """
    difference = (predicted - wanted).abs()
    if lengths is None:
        return difference.mean()
    counts = torch.tensor(lengths, device=difference.device)
    inside = torch.arange(difference.shape[1], device=difference.device) < counts[:, None]
    return (difference * inside[..., None]).sum() / (counts.sum() * difference.shape[2])


# Training targets: labels, optionally compensated for another material, and their range (a box).

# Function from forces (N, 3) N, depth (N,) m and phase (N,) to forces for the target's material and
# the number of limited ones: `learning.compensation` with its sensors and parameters bound.
Compensation = Callable[
    [NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]],
    tuple[NDArray[np.float64], int],
]


def labels_of(presses: Presses, compensation: Compensation | None = None) -> Tensor:
    """Return the training labels (N, 3) N of presses, on their device.

    Raises:
        LearningError: A frame has no label, or a compensated label is not finite.
    """
    presses.require_wrench()
    if compensation is None:
        return presses.wrench[:, :3]
    forces = presses.wrench[:, :3].double().cpu().numpy()
    changed, _ = compensation(forces, presses.depth.cpu().numpy(), presses.phase.cpu().numpy())
    if changed.shape != forces.shape or not np.isfinite(changed).all():
        raise LearningError(
            f"compensation of {presses.sensor}: found forces {changed.shape} that are not all "
            f"finite; allowed: {forces.shape}, finite"
        )
    return torch.from_numpy(changed).float().to(presses.device)


def force_range(labels: Sequence[Tensor], settings: ForceSettings) -> ForceRange:
    """Return the force range (a box) of a model's output.

    If images are mirrored, shear has both signs, and the box includes both.
    """
    if settings.force_range == "authors":
        return AUTHORS
    forces = torch.cat([each.cpu() for each in labels])
    if settings.sequences.flips:
        forces = torch.cat([forces, forces * forces.new_tensor([-1.0, -1.0, 1.0])])
    return ForceRange.from_training(forces, margin=settings.range_margin)
