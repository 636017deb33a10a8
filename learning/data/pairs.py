"""Frames of several sensors in memory, each once, and the location pairs among them.

One model serves all pairs of a group, so a frame is the source and target of many pairs. A pair is
therefore stored as two indices.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learning.data.images import shrink, unit
from learning.data.presses import read_frames_of
from learning.data.splits import Role, Split
from learning.errors import LearningError
from recorder.archive import MarkerArchive, location_pairs
from recorder.progress import ReportItems

Rows = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class PairedFrames:
    """Concatenated frames of some sensors, with those without contact, all on one device."""

    images: Tensor
    """(n, h, w) uint8, 255 where a pixel is fully marker."""
    sensor: Tensor
    """Index of the sensor of each frame (n,) int64."""
    reference: Tensor
    """Row of `references` for each frame (n,) int64."""
    references: Tensor
    """(k, h, w) uint8."""
    pairs: Tensor
    """Rows of source and target frames under the same press (m, 2) int64."""

    def __len__(self) -> int:
        return len(self.images)

    @property
    def device(self) -> torch.device:
        """Device of the frames."""
        return self.images.device

    def of_pairs(self, index: Tensor) -> Self:
        """Return the same frames with some of the pairs."""
        return replace(self, pairs=self.pairs[index])

    def to(self, device: torch.device | str) -> Self:
        """Return the same frames on another device."""
        moved: dict[str, Any] = {name: each.to(device) for name, each in vars(self).items()}
        return replace(self, **moved)

    def unit_images(self, rows: Tensor) -> Tensor:
        """Return some frames in 0..1 (m, 1, h, w) float32."""
        return unit(self.images[rows])


def paired_rows(
    archive: MarkerArchive,
    split: Split,
    sensors: Sequence[str],
    role: Role,
    *,
    every: int = 0,
    preset: str = "supplement",
) -> dict[str, Rows]:
    """Return the rows, ascending, of the frames of each sensor that have a role and can be paired.

    With `every`, every n-th frame of a press is in them as well. `preset` is the rule for pairing
    frames of a press (the presets of `recorder.archive.location_pairs`).
    """
    rows = {}
    for name in sensors:
        if name not in archive:
            raise LearningError(f"{archive.name}: no sensor {name!r}; known: {', '.join(archive)}")
        table = archive[name].table
        there = split.rows(table, role)
        # Pairing a sensor with itself gives all frames that can occur in pairs.
        chosen = np.isin(there, location_pairs(table, table, preset).source)
        if every:
            chosen |= table["frame"][there] % every == 0
        rows[name] = np.sort(there[chosen])
    return rows


def read_paired(
    archive: MarkerArchive,
    rows: Mapping[str, Rows],
    *,
    preset: str = "supplement",
    device: torch.device | str = "cpu",
    progress: ReportItems = lambda done, total: None,
) -> PairedFrames:
    """Return frames of some sensors (`paired_rows`) with their pairs in both directions."""
    sensors = [archive[name] for name in rows]
    images = read_frames_of(sensors, [*rows.values()], device, progress)
    begins = dict(zip(rows, np.cumsum([0, *map(len, rows.values())]), strict=False))
    reference, held = [np.zeros(0, np.int64)], 0
    for sensor, chosen in zip(sensors, rows.values(), strict=True):
        reference.append(held + sensor.table["reference"][chosen].astype(np.int64))
        held += len(sensor.references)
    pairs = [np.zeros((0, 2), np.int64)]
    for one, other in permutations(rows, 2):
        paired = location_pairs(archive[one].table, archive[other].table, preset)
        there = np.isin(paired.source, rows[one]) & np.isin(paired.target, rows[other])
        source = begins[one] + np.searchsorted(rows[one], paired.source[there])
        target = begins[other] + np.searchsorted(rows[other], paired.target[there])
        pairs.append(np.stack([source, target], axis=1))
    counts = torch.tensor([len(each) for each in rows.values()])
    return PairedFrames(
        images=images,
        sensor=torch.repeat_interleave(counts).to(device),
        reference=torch.from_numpy(np.concatenate(reference)).to(device),
        references=torch.from_numpy(
            shrink(np.concatenate([sensor.references for sensor in sensors]))
        ).to(device),
        pairs=torch.from_numpy(np.concatenate(pairs)).to(device),
    )
