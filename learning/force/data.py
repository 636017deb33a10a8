"""The frames and forces of a training step, taken out of presses in memory."""

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

# Which frames a training step sees. A pure function of seed, stage, epoch and step.

# Frames of the shortest sequence (the paper, Methods).
SHORTEST = 2


@dataclass(frozen=True, slots=True)
class Sequences:
    """The sequences of one step, on one process."""

    sensor: NDArray[np.int64]
    """Which of the sensors each is of (b,)."""
    rows: NDArray[np.int64]
    """Frames (b, s) of that sensor's presses; a shorter sequence repeats its last."""
    lengths: tuple[int, ...]
    """Frames (b,) of each that count."""
    flips: NDArray[np.bool_]
    """Whether columns and rows are mirrored (b, 2)."""


@dataclass(frozen=True, slots=True)
class Epoch:
    """One pass over the presses of some sensors."""

    strings: tuple[tuple[int, NDArray[np.int64]], ...]
    """Sensor and presses of each sequence, in the order in which they are learned from."""
    starts: tuple[NDArray[np.int64], ...]
    """Frames of press p of a sensor are starts[p]:starts[p + 1]."""
    settings: SequenceSettings
    seed: int
    number: int
    """Counts epochs over all stages."""

    def steps(self, ranks: int) -> int:
        """Return how many steps the pass takes with so many processes."""
        return -(-len(self.strings) // (self.settings.batch * ranks))

    def sequences(self, step: int, rank: int = 0, ranks: int = 1) -> Sequences:
        """Return the sequences of a step; the last step begins the order anew to be full."""
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
    """Return one pass over the presses of `sensors`, in an order of its own.

    Args:
        starts: Of every sensor (P + 1,): frames of press p are starts[p]:starts[p + 1].
        sensors: Which of them are learned from.
        settings: How many presses make a sequence; a few may be left over and sit this pass out.
        seed: Of the whole training.
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


# The forces that a model learns to say: labels, changed for another material, and their box.

# From forces (N, 3) N, depth (N,) m and phase (N,) to forces as the target's material would give
# them, and how many were limited: `learning.compensation` with its sensors and numbers filled in.
Compensation = Callable[
    [NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]],
    tuple[NDArray[np.float64], int],
]


def labels_of(presses: Presses, compensation: Compensation | None = None) -> Tensor:
    """Return the forces (N, 3) N that presses are learned with, on their device.

    Raises:
        LearningError: A frame has no label, or compensation makes one that is no number.
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
    """Return the box of forces that a model answers in.

    Where images are mirrored, shear has both signs, and so has the box.
    """
    if settings.force_range == "authors":
        return AUTHORS
    forces = torch.cat([each.cpu() for each in labels])
    if settings.sequences.flips:
        forces = torch.cat([forces, forces * forces.new_tensor([-1.0, -1.0, 1.0])])
    return ForceRange.from_training(forces, margin=settings.range_margin)
