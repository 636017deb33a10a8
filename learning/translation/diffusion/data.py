"""Location pairs of many sensors, with every image stored once.

One model serves all pairs of a group, so an image is the source and target of many pairs. A pair is
therefore stored as two indices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Any, Self

import numpy as np
import torch

from learning.data.images import shrink, unit
from learning.data.presses import Progress, read_frames_of
from learning.data.splits import Role, Split
from learning.errors import LearningError
from recorder.archive import MarkerArchive, location_pairs


@dataclass(frozen=True, slots=True, eq=False)
class ImagePairs:
    """N pairs of M images, with their K images without contact."""

    images: torch.Tensor
    """(M, h, w) uint8, 255 where a pixel is fully marker."""
    reference: torch.Tensor
    """Row of `references` for each image (M,) int64."""
    references: torch.Tensor
    """(K, h, w) uint8."""
    source: torch.Tensor
    """Row of `images` for the source of each pair (N,) int64."""
    target: torch.Tensor
    """Row of `images` for the target of each pair (N,) int64."""

    def __post_init__(self) -> None:
        for name in ("images", "references"):
            found = getattr(self, name)
            if found.dtype != torch.uint8 or found.ndim != 3:
                raise LearningError(
                    f"{name}: found {found.dtype} {tuple(found.shape)}; allowed: uint8 (n, h, w)"
                )
        if self.images.shape[1:] != self.references.shape[1:]:
            raise LearningError(
                f"references: found {tuple(self.references.shape)}; "
                f"allowed: images of {tuple(self.images.shape[1:])}"
            )
        ends = (
            ("reference", len(self.references)),
            ("source", len(self.images)),
            ("target", len(self.images)),
        )
        for name, end in ends:
            index = getattr(self, name)
            if len(index) and not 0 <= int(index.min()) <= int(index.max()) < end:
                raise LearningError(f"{name}: found rows beyond 0 to {end - 1}")
        if len(self.reference) != len(self.images) or len(self.source) != len(self.target):
            raise LearningError("pairs: found rows of different number; allowed: one for each")

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self.source)

    def rows(self, index: torch.Tensor) -> Self:
        """Return some of the pairs, with the same images."""
        return replace(self, source=self.source[index], target=self.target[index])

    def to(self, device: torch.device | str) -> Self:
        """Return the same pairs on another device."""
        names = ("images", "reference", "references", "source", "target")
        moved: dict[str, Any] = {name: getattr(self, name).to(device) for name in names}
        return replace(self, **moved)

    def sources(self) -> torch.Tensor:
        """Return source images (N, 1, h, w) float32 in [0, 1]."""
        return unit(self.images[self.source])

    def targets(self) -> torch.Tensor:
        """Return target images (N, 1, h, w) float32 in [0, 1]."""
        return unit(self.images[self.target])


def read_image_pairs(
    archive: MarkerArchive,
    split: Split | None,
    role: Role,
    *,
    sensors: Sequence[str] = (),
    pairs: Sequence[tuple[str, str]] = (),
    preset: str = "supplement",
    device: torch.device | str = "cpu",
    progress: Progress = lambda done, total: None,
) -> ImagePairs:
    """Return the location pairs of sensors, in both directions by default.

    Args:
        archive: Archive to read.
        split: Defines the presses of the role and the held-out sensors; None: use all.
        role: Role of the presses.
        sensors: Names; empty: all that are not held out.
        pairs: Names of source and target; empty: all permutations of the sensors.
        preset: Rule for pairing frames of a press (`recorder.archive.PRESETS`).
        device: Device for the images.
        progress: Called with the number of images read and the total.
    """
    if split is not None:
        split.check(archive)
    names = list(sensors) or [
        name for name in archive if split is None or name not in split.held_out_sensors
    ]
    wanted = list(pairs) or list(permutations(names, 2))
    if unknown := sorted({name for pair in wanted for name in pair} - set(archive)):
        raise LearningError(
            f"{archive.name}: no sensor {', '.join(unknown)}; known: {', '.join(archive)}"
        )
    found = [(pair, _paired(archive, *pair, split, role, preset)) for pair in wanted]
    used = {
        name: np.unique(
            np.concatenate([ends[pair.index(name)] for pair, ends in found if name in pair])
        )
        for name in archive
        if any(name in pair for pair, _ in found)
    }
    if not any(len(ends[0]) for _, ends in found):
        raise LearningError(
            f"{archive.name}: {', '.join(used)} have no location pairs with role {role}; "
            "allowed: sensors that were pressed at the same places"
        )
    belongs: list[torch.Tensor] = []
    references: list[torch.Tensor] = []
    first: dict[str, int] = {}
    known = 0
    for name, rows in used.items():
        sensor = archive[name]
        first[name] = sum(map(len, belongs))
        belongs.append(torch.from_numpy(sensor.table["reference"][rows].astype(np.int64)) + known)
        references.append(torch.from_numpy(shrink(sensor.references)))
        known += len(sensor.references)
    ends_of = [
        [
            torch.from_numpy(np.searchsorted(used[pair[side]], ends[side]) + first[pair[side]])
            for pair, ends in found
        ]
        for side in (0, 1)
    ]
    return ImagePairs(
        read_frames_of([archive[name] for name in used], [*used.values()], device, progress),
        torch.cat(belongs),
        torch.cat(references),
        torch.cat(ends_of[0]),
        torch.cat(ends_of[1]),
    ).to(device)


def _paired(
    archive: MarkerArchive, source: str, target: str, split: Split | None, role: Role, preset: str
) -> tuple[Any, Any]:
    one = archive[source]
    paired = location_pairs(one.table, archive[target].table, preset)
    if split is None:
        return paired.source, paired.target
    kept = np.isin(paired.source, split.rows(one.table, role))
    return paired.source[kept], paired.target[kept]


def read_role_images(
    archive: MarkerArchive,
    split: Split,
    role: Role,
    *,
    sensors: Sequence[str],
    device: torch.device | str = "cpu",
    progress: Progress = lambda done, total: None,
) -> torch.Tensor:
    """Return all frames (n, 256, 256) uint8 of several sensors that have a role.

    Args:
        archive: Archive to read.
        split: Defines the presses of the role.
        role: Role of the presses.
        sensors: Names of the sensors.
        device: Device for the images.
        progress: Called with the number of images read and the total.
    """
    if unknown := sorted(set(sensors) - set(archive)):
        raise LearningError(
            f"{archive.name}: no sensor {', '.join(unknown)}; known: {', '.join(archive)}"
        )
    chosen = [archive[name] for name in sensors]
    rows = [split.rows(sensor.table, role) for sensor in chosen]
    return read_frames_of(chosen, rows, device, progress)
