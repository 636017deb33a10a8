"""Location pairs in memory: what two sensors showed at the same place, in the same phase."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learning.data.images import shrink
from learning.data.presses import FORMS, Form, Progress, read_frames
from learning.data.splits import Role, Split
from learning.errors import LearningError
from recorder.archive import ArchivedSensor, MarkerArchive, location_pairs


@dataclass(frozen=True, slots=True, eq=False)
class PairedSensor:
    """One side of n pairs."""

    name: str
    """Of the sensor."""
    mm_per_px: float
    """Size of a pixel of the 640 x 480 image [mm]."""
    images: Tensor
    """Images (n, 256, 256) uint8, or packed masks (n, 38400), on the device."""
    references: Tensor
    """The untouched sensor (K, 256, 256) uint8, or (K, 38400) packed, on the device."""
    reference: Tensor
    """Row of `references` that belongs to each image (n,) int64, on the device."""
    rows: Tensor
    """Rows of the archive's table (n,) int64, on the CPU."""


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """What two sensors showed of the same contacts, ascending by location and then by phase."""

    source: PairedSensor
    target: PairedSensor
    location: Tensor
    """Place of each pair (n,) int64, on the CPU."""
    indenter: Tensor
    """Code of its indenter (n,) int64, on the CPU."""
    phase: Tensor
    """Code of its phase (n,) int64, on the CPU; -1: none."""

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self.location)


def load_pairs(
    archive: MarkerArchive,
    source: str,
    target: str,
    split: Split | None,
    role: Role | tuple[Role, ...],
    preset: str = "supplement",
    device: torch.device | str = "cpu",
    *,
    form: Form = "images",
    progress: Progress = lambda done, total: None,
) -> Pairs:
    """Return the location pairs of two sensors that have a role.

    Args:
        archive: What is read.
        source: Name of a sensor.
        target: Name of another.
        split: Which presses have that role; None: all pairs, whatever the role.
        role: One role, or several.
        preset: Which four frames of a press are paired: `recorder.archive.PRESETS`.
        device: Where images and references go.
        form: `images` or `packed`.
        progress: Called with the images that are read and their number.

    Raises:
        LearningError: An unknown sensor or form, a split of another archive, or no pairs.
        SessionError: An unknown preset, or an archive that is unfinished or damaged.
    """
    for name in (source, target):
        if name not in archive:
            raise LearningError(f"{archive.name}: no sensor {name!r}; known: {', '.join(archive)}")
    if form not in ("images", "packed"):
        raise LearningError(f"form: found {form!r}; allowed: {', '.join(FORMS[:2])}")
    one, other = archive[source], archive[target]
    paired = location_pairs(one.table, other.table, preset)
    kept = np.ones(len(paired), np.bool_)
    if split is not None:
        split.check(archive)
        kept = np.isin(paired.source, split.rows(one.table, role))
    if not kept.any():
        raise LearningError(
            f"{archive.name}: {source} and {target} have no location pairs with role {role}; "
            "allowed: sensors that were pressed at the same places"
        )
    rows = paired.source[kept], paired.target[kept]
    where, count = torch.device(device), len(rows[0])
    seen = _side(one, rows[0], where, form, lambda done, _: progress(done, 2 * count))
    due = _side(other, rows[1], where, form, lambda done, _: progress(count + done, 2 * count))

    def column(name: str) -> Tensor:
        return torch.from_numpy(one.table[name][rows[0]].astype(np.int64))

    return Pairs(seen, due, column("location"), column("indenter"), column("phase"))


def _side(
    sensor: ArchivedSensor,
    rows: NDArray[np.int64],
    device: torch.device,
    form: Form,
    progress: Progress,
) -> PairedSensor:
    packed = sensor.references
    references = packed if form == "packed" else shrink(packed)
    reference = sensor.table["reference"][rows].astype(np.int64)
    return PairedSensor(
        name=sensor.name,
        mm_per_px=sensor.mm_per_px,
        images=read_frames(sensor, rows, device, form, progress),
        references=torch.from_numpy(references).to(device),
        reference=torch.from_numpy(reference).to(device),
        rows=torch.from_numpy(rows),
    )
