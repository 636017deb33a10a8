"""Random marker patterns, generated on the device, for training on layouts that no sensor has.

A pattern is a lattice of markers (straight or staggered, rotated, stretched) with small variations
of position and size, and missing markers. It is drawn in material coordinates before contact, so a
deformed pattern is exact: no image is resampled, and markers enter over the border.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recorder.markers import HEIGHT, WIDTH

# Smallest and largest pitch [px of 640 x 480]: from the densest texture of the paper's simulation
# (320 markers) to a uSkin's 4 x 4 discs.
PITCH_PX = 24.0, 135.0
# Radius of a marker as a fraction of the smaller pitch.
FILL = 0.09, 0.42
# Minimum radius of a marker [px of 640 x 480]: segmentation drops smaller ones.
SMALLEST_RADIUS_PX = 4.0
# Exponents of superellipses: diamond, rounded diamond, disc, rounded square, square.
SHAPES = 1.0, 1.5, 2.0, 3.0, 8.0
# Cells along each side of the table of markers, which repeats beyond: the count of a rotated
# lattice of the smallest pitch along the image's diagonal.
CELLS = 32
# Width of the ramp at a marker's edge [px of 640 x 480]: a pixel of the networks (2.5 x 1.875).
EDGE_PX = 2.2


@dataclass(frozen=True, slots=True, eq=False)
class Patterns:
    """Layouts of markers; the first axis of everything is the pattern (n)."""

    pitch: Tensor
    """Distance of neighbours along lattice columns and rows [px of 640 x 480], (n, 2)."""
    angle: Tensor
    """Rotation of the lattice [rad], (n,)."""
    offset: Tensor
    """Offset of the lattice [cells], (n, 2)."""
    stagger: Tensor
    """Shift of odd rows [cells], (n,)."""
    exponent: Tensor
    """Exponent of the superellipse of the markers, (n,)."""
    radius: Tensor
    """Radius of each marker [px of 640 x 480], (n, CELLS * CELLS); negative: no marker."""
    shift: Tensor
    """Shift of each marker within its cell [cells], (n, CELLS * CELLS, 2)."""

    def __len__(self) -> int:
        return len(self.pitch)

    def __getitem__(self, rows: Tensor) -> Patterns:
        """Return some of the patterns, by index or mask (m,)."""
        return Patterns(*(getattr(self, column.name)[rows] for column in fields(self)))

    def draw(self, places: Tensor) -> Tensor:
        """Draw images (n, 1, h, w) in 0..1 of the material at given places.

        These are column and row before contact of the material at each pixel [px of 640 x 480], (n
        or 1, 2, h, w).
        """
        count = len(self)
        centre = places.new_tensor([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
        east, south = (places - centre[:, None, None]).unbind(dim=1)
        cosine = self.angle.cos()[:, None, None]
        sine = self.angle.sin()[:, None, None]
        pitch = self.pitch[:, :, None, None]
        column = (cosine * east + sine * south) / pitch[:, 0] + self.offset[:, 0, None, None]
        row = (cosine * south - sine * east) / pitch[:, 1] + self.offset[:, 1, None, None]
        covered = torch.zeros((count, *places.shape[2:]), device=places.device)
        for below in (-1, 0, 1):
            cell_row = row.floor() + below
            shifted = column - self.stagger[:, None, None] * cell_row.remainder(2)
            for beside in (-1, 0, 1):
                cell_column = shifted.floor() + beside
                index = cell_row.remainder(CELLS) * CELLS + cell_column.remainder(CELLS)
                index = index.long().flatten(1)
                shift = self.shift.gather(1, index[:, :, None].expand(-1, -1, 2))
                shift_column, shift_row = shift.view(*cell_row.shape, 2).unbind(dim=3)
                radius = self.radius.gather(1, index).view_as(cell_row)
                middle_column = cell_column + 0.5 + shift_column
                middle_row = cell_row + 0.5 + shift_row
                distance = self._distance(
                    (shifted - middle_column) * pitch[:, 0], (row - middle_row) * pitch[:, 1]
                )
                ink = (0.5 + (radius - distance) / EDGE_PX).clamp(0, 1)
                covered = torch.maximum(covered, ink)
        return covered.unsqueeze(1)

    def _distance(self, east: Tensor, south: Tensor) -> Tensor:
        """Return the superellipse norm of offsets [px]."""
        power = self.exponent[:, None, None]
        sum_ = (east.abs() + 1e-6) ** power + (south.abs() + 1e-6) ** power
        return sum_ ** (1 / power)


def sample_patterns(count: int, generator: np.random.Generator, device: torch.device) -> Patterns:
    """Return random patterns, the same on every device for the same generator."""
    least, most = PITCH_PX
    pitch = np.exp(generator.uniform(math.log(least), math.log(most), count))
    pitches = np.stack([pitch, pitch * np.exp(generator.uniform(-0.3, 0.3, count))], axis=1)
    turned = generator.random(count)
    angle = np.where(turned < 0.5, generator.normal(0, 0.05, count), 0.0)
    angle = np.where(turned < 0.25, generator.uniform(-math.pi / 4, math.pi / 4, count), angle)
    radius = pitches.min(axis=1) * generator.uniform(*FILL, count)
    spread = generator.uniform(0, 0.1, (count, 1)) * generator.integers(0, 2, (count, 1))
    each = radius[:, None] * (1 + spread * _table(generator, count))
    each = np.maximum(each, SMALLEST_RADIUS_PX)
    missing = generator.uniform(0, 0.05, (count, 1)) * (generator.random((count, 1)) < 0.3)
    each[generator.random(each.shape) < missing] = -EDGE_PX
    loose = generator.uniform(0, 0.06, (count, 1)) * generator.integers(0, 2, (count, 1))
    shift = np.stack([loose * _table(generator, count) for _ in range(2)], axis=2).clip(-0.2, 0.2)
    bounded = generator.random(count) < 0.3
    half = generator.uniform(0.38, 0.6, (count, 2)) * (WIDTH, HEIGHT)
    each[bounded[:, None] & ~_within(pitches, half)] = -EDGE_PX
    values = (
        pitches,
        angle,
        generator.random((count, 2)),
        np.where(generator.random(count) < 0.4, 0.5, 0.0),
        generator.choice(SHAPES, count),
        each,
        shift,
    )
    return Patterns(*(torch.from_numpy(np.asarray(v, np.float32)).to(device) for v in values))


def pixel_grid(side: int, device: torch.device) -> Tensor:
    """Return column and row of a small image's pixels (1, 2, side, side) [px of 640 x 480]."""
    steps = torch.arange(side, device=device, dtype=torch.float32) + 0.5
    columns, rows = steps * (WIDTH / side) - 0.5, steps * (HEIGHT / side) - 0.5
    grid = torch.meshgrid(rows, columns, indexing="ij")
    return torch.stack([grid[1], grid[0]])[None]


def _within(pitches: NDArray[np.float64], half: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask of the cells (n, CELLS * CELLS) within ellipses around the lattice's origin.

    Pitches of the lattices and semi-axes of the ellipses are (n, 2) [px].
    """
    steps = (np.arange(CELLS) + CELLS // 2) % CELLS - CELLS // 2 + 0.5
    rows, columns = np.meshgrid(steps, steps, indexing="ij")
    cells = np.stack([columns.ravel(), rows.ravel()], axis=1)
    away = cells[None] * (pitches / half)[:, None]
    return np.asarray((away**2).sum(axis=2) <= 1)


def _table(generator: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Return a standard normal number for each cell of each pattern."""
    return generator.standard_normal((count, CELLS * CELLS))
