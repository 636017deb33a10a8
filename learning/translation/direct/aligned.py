"""Images of several sensors that were pressed alike, in memory: what pairs are drawn from."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learning.data.fields import read_fields
from learning.data.images import shrink
from learning.data.presses import read_frames
from learning.data.splits import Role, Split
from learning.errors import LearningError
from recorder.archive import ArchivedSensor, MarkerArchive, location_pairs
from recorder.markers import Lattice

_AT_ONCE = 256


@dataclass(frozen=True, slots=True, eq=False)
class AlignedImages:
    """N moments of presses, each as S sensors show it."""

    sensors: tuple[str, ...]
    """Their names (S)."""
    images: Tensor
    """(S, N, 256, 256) uint8."""
    references: Tensor
    """The untouched sensors (K, 256, 256) uint8, those of all sensors one after the other."""
    reference: Tensor
    """Row of `references` that belongs to an image (S, N) int64."""
    location: NDArray[np.int64]
    """Place of each moment (N,)."""
    fields: Tensor | None = None
    """Displacements (F, N, 2, h, w) float16 [px of 640 x 480], of the surfaces that have them."""
    field_of: tuple[int, ...] = ()
    """Row of `fields` that belongs to a sensor (S); -1: none."""
    lattice: Lattice | None = None
    """Where the fields are kept; None: on cells that cover the image."""

    def __len__(self) -> int:
        """Return the number of moments."""
        return self.images.shape[1]


def align(
    archive: MarkerArchive,
    split: Split,
    role: Role,
    *,
    sensors: Sequence[str] | None = None,
    preset: str = "supplement",
    fields: bool = True,
    device: torch.device | str = "cpu",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> AlignedImages:
    """Return the location-paired images of an archive's sensors: moments that all of them have.

    Args:
        archive: What is read.
        split: Which locations are whose.
        role: The role whose locations are taken.
        sensors: Names of two or more; None: all that the split does not hold out.
        preset: Which frames are paired, of `recorder.archive.PRESETS`.
        fields: Whether displacement fields are read where there are any.
        device: Where all of it goes.
        progress: Called with the images that are read and their number.

    Raises:
        LearningError: A split of another archive, fewer than two sensors or one that is held out,
            or no frames that belong together.
        SessionError: No such sensor, or an archive that is damaged or still being written.
    """
    names = group(archive, split, sensors)
    chosen = [archive[name] for name in names]
    rows, location = _common_rows(chosen, preset)
    kept = np.isin(location, split.locations(role))
    rows, location = rows[:, kept], location[kept]
    if not len(location):
        raise LearningError(
            f"{archive.name}: no location of role {role} was seen by all of {', '.join(names)}"
        )
    images = []
    for done, (sensor, mine) in enumerate(zip(chosen, rows, strict=True)):
        progress(done * len(location), rows.size)
        images.append(read_frames(sensor, mine, torch.device(device)))
    progress(rows.size, rows.size)
    kinds = [torch.from_numpy(shrink(sensor.references)) for sensor in chosen]
    firsts = np.cumsum([0, *(len(kind) for kind in kinds[:-1])])
    reference = np.stack(
        [
            sensor.table["reference"][mine].astype(np.int64) + first
            for sensor, mine, first in zip(chosen, rows, firsts, strict=True)
        ]
    )
    found = _read_surfaces(chosen, rows, device) if fields else None
    return AlignedImages(
        sensors=names,
        images=torch.stack(images),
        references=torch.cat(kinds).to(device),
        reference=torch.from_numpy(reference).to(device),
        location=location,
        fields=None if found is None else found[0],
        field_of=(-1,) * len(names) if found is None else found[1],
        lattice=None if found is None else found[2],
    )


def group(
    archive: MarkerArchive, split: Split, sensors: Sequence[str] | None = None
) -> tuple[str, ...]:
    """Return the names of the sensors that are trained on together.

    Args:
        archive: Where they are.
        split: Which of them are held out.
        sensors: Those that are wanted; None: all that are not held out.

    Raises:
        LearningError: A split of another archive, fewer than two sensors or one that is held out.
    """
    split.check(archive)
    trained = split.trained_sensors(archive)
    names = tuple(sensors or trained)
    for name in names:
        if name not in trained:
            raise LearningError(f"sensors: found {name!r}; allowed: {', '.join(trained)}")
    if len(names) < 2 or len(set(names)) < len(names):
        raise LearningError(
            f"sensors: found {', '.join(names) or 'none'}; allowed: two or more different ones"
        )
    return names


def _common_rows(
    sensors: Sequence[ArchivedSensor], preset: str
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows (S, N) that belong together in all sensors, and their locations (N,)."""
    first = sensors[0].table
    pairs = [location_pairs(first, sensor.table, preset) for sensor in sensors]
    common = functools.reduce(np.intersect1d, [pair.source for pair in pairs])
    rows = np.stack([_taken(pair.source, pair.target, common) for pair in pairs])
    return rows, first["location"][common].astype(np.int64)


def _taken(
    keys: NDArray[np.int64], values: NDArray[np.int64], chosen: NDArray[np.int64]
) -> NDArray[np.int64]:
    order = np.argsort(keys)
    return values[order][np.searchsorted(keys[order], chosen)]


def _read_surfaces(
    sensors: Sequence[ArchivedSensor], rows: NDArray[np.int64], device: torch.device | str
) -> tuple[Tensor, tuple[int, ...], Lattice] | None:
    """Return fields (F, N, 2, h, w) float16, which sensor has which, and where; None without any.

    Sensors whose archived fields are the same array and the same rows share a row here too.
    """
    surfaces: list[Tensor] = []
    owners: dict[tuple[str, bytes], int] = {}
    field_of, lattice = [], None
    for sensor, mine in zip(sensors, rows, strict=True):
        if sensor.fields is None or (lattice is not None and sensor.lattice != lattice):
            field_of.append(-1)
            continue
        lattice = sensor.lattice
        key = str(sensor.attrs.get("displacement_of") or sensor.name), mine.tobytes()
        if key not in owners:
            owners[key] = len(surfaces)
            parts = [
                read_fields(sensor, mine[first : first + _AT_ONCE]).displacement.half()
                for first in range(0, len(mine), _AT_ONCE)
            ]
            surfaces.append(torch.cat(parts))
        field_of.append(owners[key])
    if lattice is None:
        return None
    return torch.stack(surfaces).to(device), tuple(field_of), lattice
