"""What the field net learns from: frames of the archive, and patterns that no sensor has.

Everything is drawn from a generator of numbers on the CPU and made on the device, so a step's
examples are the same wherever they are made.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from learning.data.images import SIDE as IMAGE_SIDE
from learning.data.procedural import Patterns, sample_patterns, untouched
from learning.translation.field.deformation import SIDE, image_grid
from learning.translation.field.distance import resampled, signed_distance
from learning.translation.field.frames import Frames
from learning.translation.field.settings import ExampleSettings
from recorder.markers import HEIGHT, WIDTH

_DRAWN_AT_ONCE = 8
_BUMPS = 3  # of which a random shift is the sum
_BUMP_PX = 30.0, 140.0  # their widths: from an edge to half of the image's height
_BUMP_MOST_PX = 40.0  # how far one moves what it pushes: past half of a 64 px pitch
_STRETCH_MOST = 0.6  # slope of a bump, so that nothing folds


@dataclass(frozen=True, slots=True, eq=False)
class Bank:
    """Random patterns, drawn once for a run."""

    patterns: Patterns
    distances: Tensor
    """Their signed distances (n, 1, 256, 256) float16 [px of 640 x 480]."""

    @classmethod
    def drawn(cls, count: int, generator: np.random.Generator, device: torch.device) -> Bank:
        """Draw `count` patterns."""
        patterns = sample_patterns(count, generator, device)
        places = _full_places(device)
        distances = []
        for first in range(0, count, _DRAWN_AT_ONCE):
            rows = torch.arange(first, min(first + _DRAWN_AT_ONCE, count), device=device)
            masks = patterns[rows].draw(places).squeeze(1) > 0.5
            distances.append(resampled(signed_distance(masks), IMAGE_SIDE).half())
        empty = torch.empty(0, 1, IMAGE_SIDE, IMAGE_SIDE, dtype=torch.half, device=device)
        return cls(patterns, torch.cat([empty, *distances]))


@dataclass(frozen=True, slots=True, eq=False)
class Examples:
    """A batch for the field net. The last `len(other)` of them are random patterns."""

    seen: Tensor
    """What it sees, in 0..1 (n, 1, 256, 256)."""
    distance: Tensor
    """Signed distance of what that was untouched (n, 1, 256, 256) [px]."""
    shown: Tensor
    """What there was to be seen: all markers, their true edges (n, 1, 256, 256)."""
    shift: Tensor
    """True shift (n, 2, 64, 64) [px], NaN where it is not known."""
    other: Tensor
    """What another pattern would have shown (m, 1, 256, 256)."""
    other_distance: Tensor
    """Signed distance of that other pattern untouched (m, 1, 256, 256) [px]."""


def draw_examples(
    frames: Frames,
    bank: Bank,
    settings: ExampleSettings,
    batch: int,
    generator: np.random.Generator,
) -> Examples:
    """Return a batch of examples, the same for the same generator."""
    made = round(batch * settings.procedural) if len(bank.distances) else 0
    rows = _rows(generator.integers(len(frames), size=batch), frames.device)
    places, sign = _views(batch, settings.move, generator, frames.device)
    shift = _moved_shifts(frames, rows, places, sign)
    own = slice(0, batch - made)
    seen = _looked_up(frames.seen(rows[own]), places[own])
    distance = _looked_up(frames.distance(rows[own]), places[own])
    if not made:
        return Examples(seen, distance, seen, shift, seen[:0], distance[:0])
    pushed = _pushed(shift[batch - made :], settings, generator)
    one, other = (
        _rows(generator.integers(len(bank.distances), size=made), frames.device) for _ in range(2)
    )
    fine = functional.interpolate(pushed, (IMAGE_SIDE, IMAGE_SIDE), mode="bicubic")
    material = untouched(IMAGE_SIDE, frames.device) - fine
    whole, missed = bank.patterns[one], _segmented(bank.patterns[one], settings, generator)
    return Examples(
        seen=torch.cat([seen, missed.draw(material)]),
        distance=torch.cat([distance, bank.distances[one].float()]),
        shown=torch.cat([seen, whole.draw(material)]),
        shift=torch.cat([shift[own], pushed]),
        other=bank.patterns[other].draw(material),
        other_distance=bank.distances[other].float(),
    )


def random_shifts(count: int, generator: np.random.Generator, device: torch.device) -> Tensor:
    """Return smooth shifts (n, 2, 64, 64) [px]: bumps that push outwards and along."""
    place = generator.uniform(0.1, 0.9, (count, _BUMPS, 2)) * (WIDTH, HEIGHT)
    least, largest = _BUMP_PX
    wide = np.exp(generator.uniform(np.log(least), np.log(largest), (count, _BUMPS, 1)))
    most = np.minimum(_BUMP_MOST_PX, _STRETCH_MOST * wide) / _BUMPS
    push = most * generator.uniform(-0.5, 1.0, (count, _BUMPS, 1))
    angle = generator.uniform(0, 2 * np.pi, (count, _BUMPS, 1))
    arrow = np.concatenate([np.cos(angle), np.sin(angle)], axis=-1)
    drag = most * generator.random((count, _BUMPS, 1)) * arrow
    centre, width, outward, along = (
        _on(each, device)[..., None, None] for each in (place, wide, push, drag)
    )
    offset = (untouched(SIDE, device).unsqueeze(1) - centre) / width
    square = offset.square().sum(dim=2, keepdim=True)
    # The outward push is greatest, exp(-1/2), one width away from the middle.
    bumps: Tensor = outward * offset * torch.exp(0.5 - square / 2) + along * torch.exp(-square / 8)
    return bumps.sum(dim=1)


def _views(
    count: int, move: float, generator: np.random.Generator, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Return where frames are looked up (n, 256, 256, 2), and the sign of each axis (n, 2)."""
    sign = _on(2.0 * generator.integers(0, 2, (count, 2)) - 1, device)
    offset = _on(generator.uniform(-move, move, (count, 2)), device)
    grid = image_grid(IMAGE_SIDE, IMAGE_SIDE, device)
    return grid * sign[:, None, None] + offset[:, None, None], sign


def _moved_shifts(frames: Frames, rows: Tensor, places: Tensor, sign: Tensor) -> Tensor:
    """Return the true shifts (n, 2, 64, 64) in views of frames; NaN where none are known."""
    if frames.shift is None:
        shape = len(rows), 2, SIDE, SIDE
        return torch.full(shape, torch.nan, device=frames.device)
    step = IMAGE_SIDE // SIDE
    cells = functional.avg_pool2d(places.permute(0, 3, 1, 2), step).permute(0, 2, 3, 1)
    return _looked_up(frames.shift[rows].float(), cells) * sign[:, :, None, None]


def _pushed(shift: Tensor, settings: ExampleSettings, generator: np.random.Generator) -> Tensor:
    """Return shifts for random patterns: the archive's, louder or softer, or random bumps."""
    count, device = len(shift), shift.device
    factor = _on(generator.uniform(*settings.amplitude, (count, 1, 1, 1)), device)
    bumps = random_shifts(count, generator, device)
    chosen = _on(generator.random((count, 1, 1, 1)), device) < settings.random_shift
    unknown = ~shift.isfinite().flatten(1).all(dim=1).view(-1, 1, 1, 1)
    return torch.where(chosen | unknown, bumps, factor * shift.nan_to_num())


def _segmented(
    patterns: Patterns, settings: ExampleSettings, generator: np.random.Generator
) -> Patterns:
    """Return patterns as segmentation finds them: edges in or out a little, markers missing."""
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


def _looked_up(images: Tensor, places: Tensor) -> Tensor:
    return functional.grid_sample(
        images, places, mode="bilinear", padding_mode="border", align_corners=False
    )


def _full_places(device: torch.device) -> Tensor:
    """Return columns and rows of the pixels of a mask (1, 2, 480, 640)."""
    rows = torch.arange(HEIGHT, device=device, dtype=torch.float32)
    columns = torch.arange(WIDTH, device=device, dtype=torch.float32)
    down, across = torch.meshgrid(rows, columns, indexing="ij")
    return torch.stack([across, down]).unsqueeze(0)


def _rows(numbers: NDArray[np.int64], device: torch.device) -> Tensor:
    return torch.from_numpy(numbers).to(device)


def _on(values: NDArray[np.floating[Any]], device: torch.device) -> Tensor:
    return torch.from_numpy(values.astype(np.float32)).to(device)
