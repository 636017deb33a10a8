"""Training data of the field net: frames of the archive, and random marker patterns.

Random numbers are drawn on the CPU and examples are computed on the device, so a step's examples do
not depend on the device.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from learning.config import require
from learning.data.images import SIDE as IMAGE_SIDE
from learning.data.images import read_fields
from learning.data.pairs import PairedFrames, paired_rows, read_paired
from learning.data.presses import FRAME_BYTES, free_bytes
from learning.data.splits import Role, Split
from learning.data.synthetic import Patterns, pixel_grid, sample_patterns
from learning.errors import LearningError
from learning.translation.field.network import (
    SIDE,
    from_displacement,
    image_grid,
    looked_up,
    resampled,
    signed_distance,
)
from learning.translation.translator import SensorView
from recorder.archive import ArchivedSensor, MarkerArchive
from recorder.markers import HEIGHT, WIDTH, unpack

_AT_ONCE = 256  # frames read at once
_SHIFT_BYTES = 2 * 2 * SIDE * SIDE  # per frame, float16
_DISTANCES_AT_ONCE = 8  # full-size masks whose distances are computed at once


@dataclass(frozen=True, slots=True)
class ExampleSettings:
    """Training examples of the field net that are made in addition to the archive's frames."""

    procedural: float = 0.5
    """Fraction of examples that are random patterns."""
    random_shift: float = 0.3
    """Fraction of those that are deformed by random bumps instead of the archive's fields."""
    patterns: int = 512
    """Number of random patterns drawn for a run; 0: none."""
    amplitude: tuple[float, float] = (0.5, 1.5)
    """Range of the factor that scales the archive's fields for random patterns."""
    move: float = 0.1
    """Largest joint translation of frame and reference, as a fraction of half the image."""
    edge_px: float = 2.0
    """Largest error of segmented marker size in random patterns, too large or small [px]."""
    missing: float = 0.05
    """Largest fraction of a random pattern's markers missing in a frame."""

    def __post_init__(self) -> None:
        require(self, "procedural", "random_shift", "missing", least=0, most=1)
        require(self, "patterns", "move", "edge_px", least=0)
        if not 0 < self.amplitude[0] <= self.amplitude[1]:
            raise LearningError(
                f"amplitude: found {list(self.amplitude)}; allowed: the smaller first, above 0"
            )


@dataclass(frozen=True, eq=False, kw_only=True)
class FieldFrames(PairedFrames):
    """Frames with what the field net compares them with, all on one device."""

    distances: Tensor
    """Signed distances of the reference masks (k, 1, 256, 256) float16 [px of 640 x 480]."""
    scales: Tensor
    """Millimetres per pixel (column, row) of each sensor (s, 2) float32."""
    shift: Tensor | None
    """True shift (n, 2, 64, 64) float16 [px], NaN if a frame has none; None: no frame has one."""

    def distance(self, rows: Tensor) -> Tensor:
        """Return signed distances of the frames' references (m, 1, 256, 256) float32 [px]."""
        return self.distances[self.reference[rows]].float()

    def scale(self, rows: Tensor) -> Tensor:
        """Return millimetres per pixel of some frames (m, 2)."""
        return self.scales[self.sensor[rows]]


def gather_role(
    archive: MarkerArchive,
    split: Split,
    sensors: Sequence[str],
    role: Role,
    *,
    every: int = 1,
    device: torch.device | str = "cpu",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> FieldFrames | None:
    """Return every n-th and all paired frames of a role; None if no press has it."""
    rows, device = paired_rows(archive, split, sensors, role, every=every), torch.device(device)
    count = sum(map(len, rows.values()))
    if not count:
        return None
    # Concatenated shifts are held twice; afterwards that half is free for training.
    needed, free = count * (FRAME_BYTES + _SHIFT_BYTES), free_bytes(device) / 2
    if needed > free:
        raise LearningError(
            f"frames: found {count:,}, {needed / 1e9:.1f} GB; allowed: {free / 1e9:.1f} GB "
            f"on {device} (a larger every_frame, fewer sensors)"
        )
    paired = read_paired(archive, rows, device=device, progress=progress)
    distances, shifts, views = [], [], []
    for name, wanted in rows.items():
        sensor = archive[name]
        for first in range(0, len(wanted), _AT_ONCE):
            shifts.append(_shifts(sensor, wanted[first : first + _AT_ONCE], device))
        own = distances_of(unpack(sensor.references), device)
        if not bool((own > 0).flatten(1).any(dim=1).all()):
            raise LearningError(f"{name}: found a reference without markers; allowed: markers")
        distances.append(own)
        views.append(SensorView.of(sensor))
    shift = torch.cat(shifts)
    return FieldFrames(
        **vars(paired),
        distances=torch.cat(distances),
        scales=torch.tensor([(v.mm_per_column, v.mm_per_row) for v in views]).to(device),
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
    """Return true shifts (n, 2, 64, 64) float16; NaN for frames without a field."""
    if sensor.fields is None:
        shape = len(rows), 2, SIDE, SIDE
        return torch.full(shape, torch.nan, dtype=torch.half, device=device)
    displacement, defined = read_fields(sensor, rows, device=device)
    shift = from_displacement(displacement, sensor.lattice).half()
    shift[~defined.flatten(1).any(dim=1)] = torch.nan
    return shift


_DRAWN_AT_ONCE = 8
_BUMPS = 3  # bumps in a random shift
_BUMP_PX = 30.0, 140.0  # range of their widths: from an edge to half of the image's height
_BUMP_MOST_PX = 40.0  # largest motion by a bump: more than half of a 64 px pitch
_STRETCH_MOST = 0.6  # slope limit of a bump that prevents folding


@dataclass(frozen=True, slots=True, eq=False)
class PatternBank:
    """Random patterns, drawn once per run."""

    patterns: Patterns
    distances: Tensor
    """Signed distances of the patterns (n, 1, 256, 256) float16 [px of 640 x 480]."""

    @classmethod
    def drawn(cls, count: int, generator: np.random.Generator, device: torch.device) -> Self:
        """Draw `count` patterns."""
        patterns = sample_patterns(count, generator, device)
        rows = torch.arange(HEIGHT, device=device, dtype=torch.float32)
        columns = torch.arange(WIDTH, device=device, dtype=torch.float32)
        down, across = torch.meshgrid(rows, columns, indexing="ij")
        points = torch.stack([across, down]).unsqueeze(0)
        distances = []
        for first in range(0, count, _DRAWN_AT_ONCE):
            some = torch.arange(first, min(first + _DRAWN_AT_ONCE, count), device=device)
            masks = patterns[some].draw(points).squeeze(1) > 0.5
            distances.append(resampled(signed_distance(masks), IMAGE_SIDE).half())
        empty = torch.empty(0, 1, IMAGE_SIDE, IMAGE_SIDE, dtype=torch.half, device=device)
        return cls(patterns, torch.cat([empty, *distances]))


@dataclass(frozen=True, slots=True, eq=False)
class Examples:
    """A batch for the field net. The last `len(other)` examples are random patterns."""

    seen: Tensor
    """Input frames, in 0..1 (n, 1, 256, 256)."""
    distance: Tensor
    """Signed distance of their references (n, 1, 256, 256) [px]."""
    shown: Tensor
    """Ideal frames: all markers, with true edges (n, 1, 256, 256)."""
    shift: Tensor
    """True shift (n, 2, 64, 64) [px], NaN where unknown."""
    other: Tensor
    """Frames of another pattern under the same deformation (m, 1, 256, 256)."""
    other_distance: Tensor
    """Signed distance of the other pattern's references (m, 1, 256, 256) [px]."""


def draw_examples(
    frames: FieldFrames,
    bank: PatternBank,
    settings: ExampleSettings,
    batch: int,
    generator: np.random.Generator,
) -> Examples:
    """Return a batch of examples, the same for the same generator."""
    procedural = round(batch * settings.procedural) if len(bank.distances) else 0
    rows = _rows(generator.integers(len(frames), size=batch), frames.device)
    # Sampling positions of frames (n, 256, 256, 2), and the sign of each axis (n, 2).
    sign = _on(2.0 * generator.integers(0, 2, (batch, 2)) - 1, frames.device)
    offset = _on(generator.uniform(-settings.move, settings.move, (batch, 2)), frames.device)
    grid = image_grid(IMAGE_SIDE, IMAGE_SIDE, frames.device)
    points = grid * sign[:, None, None] + offset[:, None, None]
    shift = _moved_shifts(frames, rows, points, sign)
    own = slice(0, batch - procedural)
    images = looked_up(frames.unit_images(rows[own]), points[own])
    distance = looked_up(frames.distance(rows[own]), points[own])
    if not procedural:
        return Examples(images, distance, images, shift, images[:0], distance[:0])
    pushed = _pushed(shift[batch - procedural :], settings, generator)
    one, other = (
        _rows(generator.integers(len(bank.distances), size=procedural), frames.device)
        for _ in range(2)
    )
    fine = functional.interpolate(pushed, (IMAGE_SIDE, IMAGE_SIDE), mode="bicubic")
    material = pixel_grid(IMAGE_SIDE, frames.device) - fine
    whole, missed = bank.patterns[one], _segmented(bank.patterns[one], settings, generator)
    return Examples(
        seen=torch.cat([images, missed.draw(material)]),
        distance=torch.cat([distance, bank.distances[one].float()]),
        shown=torch.cat([images, whole.draw(material)]),
        shift=torch.cat([shift[own], pushed]),
        other=bank.patterns[other].draw(material),
        other_distance=bank.distances[other].float(),
    )


def random_shifts(count: int, generator: np.random.Generator, device: torch.device) -> Tensor:
    """Return smooth random shifts (n, 2, 64, 64) [px]: sums of radial and lateral bumps."""
    position = generator.uniform(0.1, 0.9, (count, _BUMPS, 2)) * (WIDTH, HEIGHT)
    least, largest = _BUMP_PX
    wide = np.exp(generator.uniform(np.log(least), np.log(largest), (count, _BUMPS, 1)))
    most = np.minimum(_BUMP_MOST_PX, _STRETCH_MOST * wide) / _BUMPS
    push = most * generator.uniform(-0.5, 1.0, (count, _BUMPS, 1))
    angle = generator.uniform(0, 2 * np.pi, (count, _BUMPS, 1))
    arrow = np.concatenate([np.cos(angle), np.sin(angle)], axis=-1)
    drag = most * generator.random((count, _BUMPS, 1)) * arrow
    centre, width, outward, along = (
        _on(each, device)[..., None, None] for each in (position, wide, push, drag)
    )
    offset = (pixel_grid(SIDE, device).unsqueeze(1) - centre) / width
    square = offset.square().sum(dim=2, keepdim=True)
    # The outward push is largest, exp(-1/2), one width from the centre.
    bumps: Tensor = outward * offset * torch.exp(0.5 - square / 2) + along * torch.exp(-square / 8)
    return bumps.sum(dim=1)


def _moved_shifts(frames: FieldFrames, rows: Tensor, points: Tensor, sign: Tensor) -> Tensor:
    """Return the true shifts (n, 2, 64, 64) in views of frames; NaN where unknown."""
    if frames.shift is None:
        shape = len(rows), 2, SIDE, SIDE
        return torch.full(shape, torch.nan, device=frames.device)
    step = IMAGE_SIDE // SIDE
    cells = functional.avg_pool2d(points.permute(0, 3, 1, 2), step).permute(0, 2, 3, 1)
    return looked_up(frames.shift[rows].float(), cells) * sign[:, :, None, None]


def _pushed(shift: Tensor, settings: ExampleSettings, generator: np.random.Generator) -> Tensor:
    """Return shifts for random patterns: scaled ones of the archive, or random bumps."""
    count, device = len(shift), shift.device
    factor = _on(generator.uniform(*settings.amplitude, (count, 1, 1, 1)), device)
    bumps = random_shifts(count, generator, device)
    chosen = _on(generator.random((count, 1, 1, 1)), device) < settings.random_shift
    unknown = ~shift.isfinite().flatten(1).all(dim=1).view(-1, 1, 1, 1)
    return torch.where(chosen | unknown, bumps, factor * shift.nan_to_num())


def _segmented(
    patterns: Patterns, settings: ExampleSettings, generator: np.random.Generator
) -> Patterns:
    """Return patterns with segmentation errors: edges slightly in or out, markers missing."""
    count, device = len(patterns), patterns.radius.device
    edge = generator.uniform(-settings.edge_px, settings.edge_px, (count, 1))
    missing = generator.uniform(0, settings.missing, (count, 1))
    missed = generator.random(tuple(patterns.radius.shape)) < missing
    radius = torch.where(
        torch.from_numpy(missed).to(device) | (patterns.radius < 0),
        patterns.radius.new_tensor(-WIDTH),
        (patterns.radius + _on(edge, device)).clamp(min=1.0),
    )
    return replace(patterns, radius=radius)


def _rows(numbers: NDArray[np.int64], device: torch.device) -> Tensor:
    return torch.from_numpy(numbers).to(device)


def _on(values: NDArray[np.floating[Any]], device: torch.device) -> Tensor:
    return torch.from_numpy(values.astype(np.float32)).to(device)
