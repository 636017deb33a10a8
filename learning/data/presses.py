"""Presses of a sensor, in memory or read from the archive on demand, and their force range."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from learning.data.images import SIDE, shrink, shrink_masks, unpack_masks
from learning.errors import LearningError
from recorder.archive import SHADING, ArchivedSensor
from recorder.progress import ReportItems

# Form of a frame in memory: an image (256, 256) uint8; its packed mask (38400,) uint8; or the
# marker field (3, 32, 32) float32: columns [px of 640 x 480], rows [px], log of the area change; or
# the shading (3, 128, 128) uint8 of a gel without markers.
Form = Literal["images", "packed", "field", "shading"]


_AT_ONCE = 256
_IMAGE = (SIDE, SIDE)
_ON_DEVICE = ("images", "references", "reference", "wrench")
_OF_PRESS = ("location", "indenter", "target")


@dataclass(frozen=True, slots=True, eq=False)
class Presses:
    """P presses of one sensor with N frames in total, stored press by press."""

    sensor: str
    mm_per_px: float
    """Size of a pixel of the 640 x 480 image [mm]."""
    form: Form
    """Form of `images`."""
    images: Tensor
    """Frames (N, ...) in that form, on the device."""
    references: Tensor
    """Images without contact (K, 256, 256) uint8, (K, 38400) packed, or (K, 3, 128, 128) of
    shading, on the device."""
    reference: Tensor
    """Row of `references` for each frame (N,) int64, on the device."""
    wrench: Tensor
    """Fx, Fy, Fz (N, 3) float32 [N], on the device; NaN on axes without a label."""
    starts: Tensor
    """Frames of press p are starts[p]:starts[p + 1], in order of time: (P + 1,) int64."""
    location: Tensor
    """Location of each press, equal across sensors (P,) int64; -1: none."""
    indenter: Tensor
    """Code of each press's indenter (P,) int64."""
    target: Tensor
    """Number of each press within its indenter (P,) int64."""
    phase: Tensor
    """Code of the phase (N,) int64; -1: none."""
    depth: Tensor
    """Commanded indentation (N,) float64 [m]."""
    frame: Tensor
    """Number of the frame within its press (N,) int64."""
    rows: Tensor
    """Row of the archive's table (N,) int64."""
    spread: Tensor | None = None
    """Standard deviation of the labels (N, 3) float32 [N], on the device; None: equally certain."""

    def __len__(self) -> int:
        return len(self.starts) - 1

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.rows)

    @property
    def device(self) -> torch.device:
        """Device of images, references and wrench; everything else is on the CPU."""
        return self.images.device

    @property
    def of_frame(self) -> Tensor:
        """Press of each frame (N,) int64, on the CPU."""
        return torch.repeat_interleave(torch.arange(len(self)), self.starts.diff())

    def each_frame_alone(self) -> Self:
        """Return the same frames, each as a separate press without history."""
        press = self.of_frame
        values: dict[str, Any] = {"starts": torch.arange(self.frames + 1)}
        for each in _OF_PRESS:
            values[each] = getattr(self, each)[press]
        return replace(self, **values)

    def only(self, chosen: Tensor) -> Self:
        """Return the presses where `chosen` (P,) is true, on the CPU, with their frames."""
        frames = chosen[self.of_frame]
        on_device = frames.to(self.device)
        lengths = self.starts.diff()[chosen]
        values: dict[str, Any] = {"starts": torch.cat((lengths.new_zeros(1), lengths.cumsum(0)))}
        for names, rows in (
            (("images", "reference", "wrench"), on_device),
            (_OF_PRESS, chosen),
            (("phase", "depth", "frame", "rows"), frames),
        ):
            values |= {name: getattr(self, name)[rows] for name in names}
        spread = None if self.spread is None else self.spread[on_device]
        return replace(self, spread=spread, **values)

    def to(self, device: torch.device | str) -> Self:
        """Return the same presses on another device."""
        moved: dict[str, Any] = {name: getattr(self, name).to(device) for name in _ON_DEVICE}
        return replace(self, **moved)

    def require_wrench(self) -> None:
        """Reject presses from which no force can be learned: no axis has a label in any frame."""
        if self.wrench.isinf().any():
            row = int(self.rows[self.wrench.isinf().any(dim=1).cpu()][0])
            raise LearningError(
                f"sensor {self.sensor}: found an infinite wrench in row {row}; allowed: numbers, "
                "or NaN without a label"
            )
        if not self.is_labelled:
            raise LearningError(
                f"sensor {self.sensor}: found no label of Fx, Fy or Fz in {self.frames:,} frames; "
                "allowed: one or more to learn forces from"
            )

    @property
    def is_labelled(self) -> bool:
        """True if an axis of force has a label in one frame or more."""
        return bool(self.wrench[:, :3].isfinite().any())


def load_presses(
    sensor: ArchivedSensor,
    rows: Any,
    *,
    device: torch.device | str = "cpu",
    form: Form = "images",
    processes: int = 1,
    progress: ReportItems = lambda done, total: None,
) -> Presses:
    """Load presses of rows of an archive's sensor, in any order; a press is a location.

    Frames without a location, e.g. of force-depth presses, are grouped by their target. Markers of
    fields are tracked by some processes.
    """
    if (form == "shading") != (sensor.representation == SHADING):
        needed = "--preset shading" if sensor.representation == SHADING else "another preset"
        raise LearningError(
            f"{sensor.name}: holds {sensor.representation.name}, the model takes {form}; allowed: "
            f"a model trained with {needed}"
        )
    described = press_table(sensor, rows)
    if form == "field":
        frames = _read_fields(sensor, described, processes, progress)
    else:
        frames = read_frames(sensor, described.rows.numpy(), torch.device(device), form, progress)
    references = sensor.reference_frames
    if form in ("images", "field"):
        references = shrink(references)
    return replace(described, form=form, images=frames, references=torch.from_numpy(references)).to(
        device
    )


def press_table(sensor: ArchivedSensor, rows: Any) -> Presses:
    """Return presses without image data.

    Their `images` (N, 256, 256) and `references` are on the device `meta`: they have a shape but no
    data, and torch raises an error if they are read.
    """
    table = sensor.table
    chosen = np.asarray(rows, np.int64)
    if (missing := chosen[~table["valid"][chosen]]).size:
        (why,) = sensor.provenance(missing[:1])
        raise LearningError(
            f"{sensor.name}: row {missing[0]} is not valid ({why}); allowed: rows with a frame"
        )
    key = np.stack(
        [table[name][chosen].astype(np.int64) for name in ("location", "indenter", "target")]
    )
    # The target separates presses without a location; a location belongs to a single press anyway.
    order = np.lexsort((table["frame"][chosen], key[2], key[1], key[0]))
    chosen, key = chosen[order], key[:, order]
    begins = np.flatnonzero(np.r_[len(chosen) > 0, (np.diff(key) != 0).any(axis=0)])
    _require_one_press(sensor, key, begins)

    def column(name: str, dtype: type = np.int64) -> Tensor:
        return torch.from_numpy(table[name][chosen].astype(dtype))

    return Presses(
        sensor=sensor.name,
        mm_per_px=sensor.mm_per_px,
        form="images",
        images=torch.empty(len(chosen), *_IMAGE, dtype=torch.uint8, device="meta"),
        references=torch.empty(
            len(sensor.reference_frames), *_IMAGE, dtype=torch.uint8, device="meta"
        ),
        reference=column("reference"),
        wrench=torch.from_numpy(table["wrench"][chosen, :3].astype(np.float32)),
        starts=torch.from_numpy(np.r_[begins, len(chosen)].astype(np.int64)),
        location=torch.from_numpy(key[0, begins]),
        indenter=torch.from_numpy(key[1, begins]),
        target=torch.from_numpy(key[2, begins]),
        phase=column("phase"),
        depth=column("depth", np.float64),
        frame=column("frame"),
        rows=torch.from_numpy(chosen),
    )


def read_frames(
    sensor: ArchivedSensor,
    rows: NDArray[np.int64],
    device: torch.device,
    form: Form = "images",
    progress: ReportItems = lambda done, total: None,
) -> Tensor:
    """Read images (n, 256, 256), or frames as stored (n, ...), of rows, uint8, to a device."""
    shape = _IMAGE if form == "images" else sensor.representation.shape
    frames = torch.empty(len(rows), *shape, dtype=torch.uint8, device=device)
    progress(0, len(rows))
    for first in range(0, len(rows), _AT_ONCE):
        some = rows[first : first + _AT_ONCE]
        if form != "images":
            read = torch.from_numpy(sensor.frames(some))
        elif device.type == "cpu":
            read = torch.from_numpy(shrink(sensor.packed(some)))
        else:
            # Bits are transferred and unpacked on the device: an eighth of the traffic and of the
            # CPU's work.
            read = shrink_masks(unpack_masks(torch.from_numpy(sensor.packed(some)).to(device)))
        frames[first : first + len(read)] = read
        progress(first + len(read), len(rows))
    return frames


def read_frames_of(
    sensors: Sequence[ArchivedSensor],
    rows: Sequence[NDArray[np.int64]],
    device: torch.device | str,
    progress: ReportItems = lambda done, total: None,
) -> Tensor:
    """Read images (n, 256, 256) uint8 of the rows of several sensors, one after another."""
    total, done = sum(map(len, rows)), 0
    images = torch.empty(total, *_IMAGE, dtype=torch.uint8, device=device)
    for sensor, mine in zip(sensors, rows, strict=True):
        images[done : done + len(mine)] = read_frames(
            sensor,
            mine,
            images.device,
            progress=lambda read, _, before=done: progress(before + read, total),  # type: ignore[misc]
        )
        done += len(mine)
    return images


def _read_fields(
    sensor: ArchivedSensor, presses: Presses, processes: int, progress: ReportItems
) -> Tensor:
    """Return marker fields (N, 3, 32, 32) float32 on the CPU."""
    # Imported here, as only marker fields need it.
    from learning.markers.displacement import fields_of_presses

    rows = presses.rows.numpy()
    fields = fields_of_presses(
        lambda first, end: sensor.packed(rows[first:end]),
        presses.starts.numpy(),
        sensor.references,
        presses.reference.numpy(),
        "maps",
        processes=processes,
        progress=progress,
    )
    return torch.from_numpy(fields)


def _require_one_press(
    sensor: ArchivedSensor, key: NDArray[np.int64], begins: NDArray[np.int64]
) -> None:
    location = key[0, begins]
    twice = np.flatnonzero((np.diff(location) == 0) & (location[1:] >= 0))
    if twice.size:
        raise LearningError(
            f"{sensor.name}: location {location[twice[0]]} belongs to several presses; allowed: one"
        )


# Force range of a model, whose last layer gives numbers from 0 to 1.
#
# The paper normalises by the minimum and maximum force of each axis (Methods); the authors' code
# has fixed values. Here they come from the training split and are stored with the model. An axis
# without a label has the range NaN to NaN, so that a model's force on it is NaN, never a guess.

Force = tuple[float, float, float]

# Minimum width of the range along an axis [N]; smaller differences carry no signal.
LEAST = 1e-3


@dataclass(frozen=True, slots=True)
class ForceRange:
    """Minimum and maximum force of each axis."""

    low: Force
    """Fx, Fy, Fz [N] that map to 0; NaN for an axis that was not measured."""
    high: Force
    """Fx, Fy, Fz [N] that map to 1."""

    def __post_init__(self) -> None:
        ends = np.array([self.low, self.high], np.float64)
        measured = ~np.isnan(ends).all(axis=0)
        bounds = ends[:, measured] if ends.shape == (2, 3) else ends
        if (
            ends.shape != (2, 3)
            or not bounds.size
            or not np.isfinite(bounds).all()
            or (bounds[0] >= bounds[1]).any()
        ):
            raise LearningError(
                f"force range: found {self.low} to {self.high}; allowed: three finite forces [N] "
                "each, low < high, or NaN in both for an axis that was not measured"
            )

    @classmethod
    def from_training(cls, forces: ArrayLike, *, margin: float = 0.0) -> Self:
        """Return the range of forces (n, 3) [N]; NaN is no label.

        `margin` is the fraction of the range to add at both ends, as a sigmoid never reaches its
        limits.
        """
        forces = np.asarray(forces, np.float64)
        unknown = np.isnan(forces)
        low = np.where(unknown, np.inf, forces).min(axis=0)
        high = np.where(unknown, -np.inf, forces).max(axis=0)
        never = unknown.all(axis=0)
        low[never] = high[never] = np.nan
        wider = np.maximum(LEAST - (high - low), 0) / 2 + margin * (high - low)
        return cls(force_of(low - wider), force_of(high + wider))


# Fixed range of the authors' code.
AUTHORS = ForceRange((-5.0, -5.0, -20.0), (5.0, 5.0, 5.0))


def force_of(values: NDArray[np.float64]) -> Force:
    """Return Fx, Fy, Fz (3,) [N] as numbers."""
    x, y, z = (float(value) for value in values)
    return x, y, z


# Memory of an image [bytes].
FRAME_BYTES = SIDE * SIDE


def free_bytes(device: torch.device) -> int:
    """Return the free memory of a device [bytes]."""
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
