"""Which frames a training step sees. A pure function of seed, stage, epoch and step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from learning.force.settings import SequenceSettings
from learning.training.sampling import generator

SHORTEST = 2
"""Frames of the shortest sequence (the paper, Methods)."""


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
