"""What a field model is trained on: frames of several sensors, and which belong together."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learning.data.fields import read_fields
from learning.data.images import SIDE as IMAGE_SIDE
from learning.data.presses import read_frames
from learning.data.residence import FRAME_BYTES, free_bytes
from learning.data.splits import Role, Split
from learning.errors import LearningError
from learning.translation.field.deformation import SIDE, from_displacement
from learning.translation.field.distance import resampled, signed_distance
from learning.translation.translator import SensorView
from recorder.archive import ArchivedSensor, MarkerArchive, location_pairs
from recorder.markers import unpack

_AT_ONCE = 256  # frames that are read together
_SHIFT_BYTES = 2 * 2 * SIDE * SIDE  # of a frame, float16
_DISTANCES_AT_ONCE = 8  # full-size masks whose distances are worked out together


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Frames of some sensors, one after the other, all on one device."""

    images: Tensor
    """(n, 256, 256) uint8."""
    sensor: Tensor
    """Which sensor each is of (n,) int64."""
    reference: Tensor
    """Row of `distances` of each (n,) int64."""
    distances: Tensor
    """Signed distance of the untouched sensors (k, 1, 256, 256) float16 [px of 640 x 480]."""
    scales: Tensor
    """Millimetres of a pixel along columns and rows, of each sensor (s, 2) float32."""
    pairs: Tensor
    """Rows of frames of two sensors under the same press, source and target (m, 2) int64."""
    shift: Tensor | None = None
    """True shift (n, 2, 64, 64) float16 [px], NaN of frames without; None: no frame has one."""

    def __post_init__(self) -> None:
        """Refuse what does not fit together.

        Raises:
            LearningError: Shapes that differ from what is said above, or no frame at all.
        """
        count, square = len(self.images), (IMAGE_SIDE, IMAGE_SIDE)
        due = {
            "images": (count, *square),
            "sensor": (count,),
            "reference": (count,),
            "distances": (len(self.distances), 1, *square),
            "scales": (len(self.scales), 2),
            "pairs": (len(self.pairs), 2),
        }
        if self.shift is not None:
            due["shift"] = (count, 2, SIDE, SIDE)
        for name, shape in due.items():
            found = tuple(getattr(self, name).shape)
            if found != shape:
                raise LearningError(f"{name}: found shape {found}; allowed: {shape}")
        if not count:
            raise LearningError("images: found none; allowed: one frame and more")

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.images)

    @property
    def device(self) -> torch.device:
        """Where they are."""
        return self.images.device

    def seen(self, rows: Tensor) -> Tensor:
        """Return frames in 0..1 (m, 1, 256, 256) float32."""
        return self.images[rows].unsqueeze(1).float() / 255

    def distance(self, rows: Tensor) -> Tensor:
        """Return signed distances of the references of frames (m, 1, 256, 256) float32 [px]."""
        return self.distances[self.reference[rows]].float()

    def scale(self, rows: Tensor) -> Tensor:
        """Return millimetres of a pixel of frames (m, 2)."""
        return self.scales[self.sensor[rows]]


def gather_role(
    archive: MarkerArchive,
    split: Split,
    sensors: Sequence[str],
    role: Role,
    *,
    every: int = 1,
    preset: str = "supplement",
    device: torch.device | str = "cpu",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Frames | None:
    """Return the frames of some sensors that have a role; None where no press has it.

    Args:
        archive: Where they are.
        split: Of its presses.
        sensors: Their names.
        role: Of the presses.
        every: Frames are taken whose number within the press this divides, and paired ones.
        preset: Which frames of a press are paired (`recorder.archive.PRESETS`).
        device: Where they go.
        progress: Called with the frames that were read and those there are.

    Raises:
        LearningError: An unknown sensor, or a reference that has no marker.
        SessionError: A damaged archive.
    """
    rows = {}
    for name in sensors:
        if name not in archive:
            raise LearningError(f"{archive.name}: no sensor {name!r}; known: {', '.join(archive)}")
        table = archive[name].table
        there = split.rows(table, role)
        # A sensor paired with itself: the frames of it that a pair can have.
        paired = np.isin(there, location_pairs(table, table, preset).source)
        rows[name] = np.sort(there[paired | (table["frame"][there] % every == 0)])
    if not any(map(len, rows.values())):
        return None
    return gather_frames(archive, rows, preset=preset, device=device, progress=progress)


def gather_frames(
    archive: MarkerArchive,
    rows: Mapping[str, NDArray[np.int64]],
    *,
    preset: str = "supplement",
    device: torch.device | str = "cpu",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Frames:
    """Return frames of an archive, and the location pairs among them.

    Args:
        archive: Where they are.
        rows: Which frames of which sensors, ascending; more than one sensor to pair them.
        preset: Which frames of a press are paired (`recorder.archive.PRESETS`).
        device: Where they go.
        progress: Called with the frames that were read and those there are.

    Raises:
        LearningError: No frame, more of them than there is memory for, an unknown sensor, or one
            whose reference has no marker.
        SessionError: A damaged archive.
    """
    if not any(map(len, rows.values())):
        raise LearningError(f"{archive.name}: found no frame to learn from; allowed: one and more")
    device = torch.device(device)
    _require_room(sum(map(len, rows.values())), device)
    images, references, distances, shifts = [], [], [], []
    begun = held = 0
    for name, wanted in rows.items():
        if name not in archive:
            raise LearningError(f"{archive.name}: no sensor {name!r}; known: {', '.join(archive)}")
        sensor = archive[name]
        so_far = functools.partial(_passed_on, progress, begun, sum(map(len, rows.values())))
        images.append(read_frames(sensor, wanted, device, progress=so_far))
        begun += len(wanted)
        for first in range(0, len(wanted), _AT_ONCE):
            shifts.append(_shifts(sensor, wanted[first : first + _AT_ONCE], device))
        own = distances_of(unpack(sensor.references), device)
        if not bool((own > 0).flatten(1).any(dim=1).all()):
            raise LearningError(f"{name}: found a reference without markers; allowed: markers")
        distances.append(own)
        references.append(held + sensor.table["reference"][wanted].astype(np.int64))
        held += len(own)
    counts = [len(each) for each in rows.values()]
    views = [SensorView.of(archive[name]) for name in rows]
    shift = torch.cat(shifts)
    return Frames(
        images=torch.cat(images),
        sensor=torch.repeat_interleave(torch.tensor(counts)).to(device),
        reference=torch.from_numpy(np.concatenate(references)).to(device),
        distances=torch.cat(distances),
        scales=torch.tensor([(v.mm_per_column, v.mm_per_row) for v in views]).to(device),
        pairs=torch.from_numpy(_pairs(archive, rows, preset)).to(device),
        shift=shift if bool(shift.isfinite().any()) else None,
    )


def distances_of(masks: NDArray[np.bool_], device: torch.device | str) -> Tensor:
    """Return signed distances (k, 1, 256, 256) float16 [px of 640 x 480] of masks (k, 480, 640)."""
    small = [
        resampled(
            signed_distance(torch.from_numpy(masks[first : first + _DISTANCES_AT_ONCE]).to(device)),
            IMAGE_SIDE,
        )
        for first in range(0, len(masks), _DISTANCES_AT_ONCE)
    ]
    return torch.cat(small).half()


def _shifts(sensor: ArchivedSensor, rows: NDArray[np.int64], device: torch.device) -> Tensor:
    """Return true shifts (n, 2, 64, 64) float16; NaN of frames without a field."""
    if sensor.fields is None:
        shape = len(rows), 2, SIDE, SIDE
        return torch.full(shape, torch.nan, dtype=torch.half, device=device)
    fields = read_fields(sensor, rows, device=device)
    shift = from_displacement(fields.displacement, fields.lattice).half()
    shift[~fields.known.flatten(1).any(dim=1)] = torch.nan
    return shift


def _require_room(count: int, device: torch.device) -> None:
    """Refuse more frames than a device has memory for.

    Raises:
        LearningError: Images and fields would not leave enough for the training.
    """
    # They are there twice while those of all sensors are joined; later there is room to train.
    needed, free = count * (FRAME_BYTES + _SHIFT_BYTES), free_bytes(device) / 2
    if needed > free:
        raise LearningError(
            f"frames: found {count:,}, {needed / 1e9:.1f} GB; allowed: {free / 1e9:.1f} GB on "
            f"{device} (a larger every_frame, fewer sensors)"
        )


def _passed_on(
    progress: Callable[[int, int], None], begun: int, total: int, done: int, _: int
) -> None:
    progress(begun + done, total)


def _pairs(
    archive: MarkerArchive, rows: Mapping[str, NDArray[np.int64]], preset: str
) -> NDArray[np.int64]:
    """Return where in the frames the location pairs of all directed pairs of sensors are (m, 2)."""
    begins = np.cumsum([0, *(len(each) for each in rows.values())])
    found = [np.zeros((0, 2), np.int64)]
    for source, source_begin in zip(rows, begins, strict=False):
        for target, target_begin in zip(rows, begins, strict=False):
            if source == target:
                continue
            pairs = location_pairs(archive[source].table, archive[target].table, preset)
            there = np.isin(pairs.source, rows[source]) & np.isin(pairs.target, rows[target])
            one = source_begin + np.searchsorted(rows[source], pairs.source[there])
            other = target_begin + np.searchsorted(rows[target], pairs.target[there])
            found.append(np.stack([one, other], axis=1).astype(np.int64))
    return np.concatenate(found)
