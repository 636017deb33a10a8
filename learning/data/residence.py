"""Where the frames of a training lie: all in the memory of the device, or still in the archive.

Both give the same batches, as which frames a step sees is decided before, by seed and step alone
(`learning.training.sampling`). 180,000 frames are 11.8 GB in memory; where that is too much, worker
processes read what is asked for, in order and ahead of time.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from learning.data.images import SIDE
from learning.data.presses import Presses, Progress, load_presses, press_table, read_frames
from learning.errors import LearningError
from recorder.archive import ArchivedSensor

FRAME_BYTES = SIDE * SIDE
"""Memory that an image takes."""
SHARE = 0.6
"""Of the free memory images may take this much: the network and its gradients want the rest."""

Numbers = NDArray[np.int64]


class FrameSource(Protocol):
    """Gives images by the number of their frame among the presses."""

    def batches(self, wanted: Iterable[Numbers]) -> Iterator[Tensor]:
        """Yield, for each list of frame numbers (n,), images (n, 256, 256) uint8 on the device."""
        ...


@dataclass(frozen=True, slots=True)
class Resident:
    """All images in the device's memory."""

    presses: Presses

    def batches(self, wanted: Iterable[Numbers]) -> Iterator[Tensor]:
        """Yield images (n, 256, 256) for each list of frame numbers."""
        for numbers in wanted:
            yield self.presses.images[torch.from_numpy(numbers).to(self.presses.device)]


@dataclass(frozen=True, slots=True)
class Streaming:
    """Images read from the archive by worker processes when they are needed."""

    sensor: ArchivedSensor
    presses: Presses
    device: torch.device
    workers: int
    """Processes; 0 reads in this one."""

    def batches(self, wanted: Iterable[Numbers]) -> Iterator[Tensor]:
        """Yield images (n, 256, 256) for each list of frame numbers."""
        loader: DataLoader[Tensor] = DataLoader(
            _Read(self.sensor, self.presses.rows.numpy()),
            batch_size=None,
            sampler=_Wanted(wanted),
            num_workers=self.workers,
            pin_memory=self.device.type == "cuda",
        )
        for images in loader:
            yield images.to(self.device, non_blocking=True)


def open_frames(
    sensor: ArchivedSensor,
    rows: Any,
    *,
    device: torch.device | str = "cpu",
    workers: int = 4,
    share: float = SHARE,
    progress: Progress = lambda done, total: None,
) -> tuple[Presses, FrameSource]:
    """Return presses and where their images come from: memory if they fit, else the archive.

    Where they do not fit, the presses' own `images` have a shape and no content.

    Args:
        sensor: What is read.
        rows: Rows of its table.
        device: Where images are wanted.
        workers: Processes that read, if they do not fit; 0: none but this one.
        share: Of the free memory that images may take.
        progress: Called with the frames that are read and their number.

    Raises:
        LearningError: Rows that repeat or are not valid, or a wrong number.
        SessionError: No such row, or an archive that is unfinished or damaged.
    """
    if workers < 0 or not 0 <= share <= 1:
        raise LearningError(
            f"workers, share: found {workers}, {share}; allowed: 0 and more, 0 to 1"
        )
    where = torch.device(device)
    described = press_table(sensor, rows)
    if described.frames * FRAME_BYTES <= share * free_bytes(where):
        presses = load_presses(sensor, rows, device=where, progress=progress)
        return presses, Resident(presses)
    return described, Streaming(sensor, described, where, workers)


def free_bytes(device: torch.device) -> int:
    """Return how much memory of a device is free."""
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


class _Read(Dataset[Tensor]):
    """Reads a batch: its index is the list of frame numbers."""

    def __init__(self, sensor: ArchivedSensor, rows: Numbers) -> None:
        self._sensor, self._rows = sensor, rows

    def __getitem__(self, numbers: Numbers) -> Tensor:
        return read_frames(self._sensor, self._rows[numbers], torch.device("cpu"))


class _Wanted:
    """Lets a loader take lists of frame numbers for the indices of a data set."""

    def __init__(self, wanted: Iterable[Numbers]) -> None:
        self._wanted = wanted

    def __iter__(self) -> Iterator[Numbers]:
        return iter(self._wanted)
