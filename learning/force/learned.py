"""Frames that a model learned from, by the shape of their markers: others far from all are flagged.

The shape of a frame is some numbers of its markers: how far they moved, and how unevenly, and how
much of the image they cover, in all and by parts of it. The distance of a frame is that to the
nearest learned one, in units in which learned frames have unit covariance. Needs numpy alone.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Count of numbers in a shape.
SHAPE = 7
# Cells down and across the image, in which markers are counted; coarse ones are 2 x 2 of these.
_CELLS = 8
# Share of the frames of indenters that were held out that may be flagged.
FLAGGED = 0.01
# Number of learned frames that are kept.
_KEPT = 1000
# Share of each number's variance that is added to it: few frames may not vary in all directions.
_RIDGE, _LEAST = 1e-3, 1e-8


@dataclass(frozen=True)
class Learned:
    """Shapes of the frames that a model learned from."""

    units: tuple[tuple[float, ...], ...]
    """Matrix (7, 7) that multiplies shapes, after which learned ones have unit covariance."""
    shapes: tuple[tuple[float, ...], ...]
    """Shapes of some of the frames (k, 7), multiplied."""
    limit: float
    """Distance above which a frame is outside."""

    @functools.cached_property
    def _arrays(self) -> tuple[Floats, Floats]:
        return np.array(self.units, np.float64), np.array(self.shapes, np.float64)

    def distances(self, shapes: Floats) -> Floats:
        """Return the distance of shapes (n, 7) from the nearest learned one (n,)."""
        units, learned = self._arrays
        found = [
            np.square(shape - learned).sum(axis=1).min()
            for shape in np.asarray(shapes, np.float64) @ units
        ]
        return np.sqrt(np.array(found, np.float64))

    def is_far(self, shapes: Floats) -> NDArray[np.bool_]:
        """Return True for shapes (n, 7) that are beyond the limit."""
        return np.asarray(self.distances(shapes) > self.limit, np.bool_)


def fit_learned(learned: Floats, held_out: Floats) -> Learned:
    """Return what was learned, with the limit that flags about 1 % of a new indenter's frames.

    Args:
        learned: Shapes of frames learned from (n, 7); 1,000 of them are kept.
        held_out: Shapes of frames of indenters that were not (m, 7). The limit is the
            ceil(0.99 (m + 1))-th smallest of their distances, or the largest.
    """
    covariance = np.cov(learned.T)
    ridge = np.diag(_RIDGE * np.diag(covariance) + _LEAST)
    units = np.linalg.cholesky(np.linalg.inv(covariance + ridge))
    kept = np.unique(np.linspace(0, len(learned) - 1, _KEPT).round().astype(int))
    found = Learned(_rows(units), _rows((learned[kept] @ units).round(4)), math.inf)
    distances = np.sort(found.distances(held_out))
    rank = min(len(distances), math.ceil((1 - FLAGGED) * (len(distances) + 1)))
    return replace(found, limit=float(distances[rank - 1]))


def _rows(matrix: Floats) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, matrix.tolist()))


def shapes_of(masks: NDArray[np.bool_], reference: NDArray[np.bool_]) -> Floats:
    """Return the shapes of frames.

    Args:
        masks: Frames (n, 480, 640).
        reference: The mask without contact (480, 640), with markers.

    Returns:
        Shapes (n, 7), each relative to the reference's markers per cell: mean and standard
        deviation over cells of their motion [px], standard deviation of the change of their area,
        its least and most in coarse cells; then their share of the image [%], and the length of
        their edges over that of an image [px of its width].
    """
    edge, area = _of_reference(reference.tobytes(), reference.shape)
    found = np.zeros((len(masks), SHAPE))
    for row, mask in zip(found, masks, strict=True):
        moved = _cells(mask != reference) / edge
        grown = (_cells(mask) - area) / area.mean()
        coarse = grown.reshape(_CELLS // 2, 2, _CELLS // 2, 2).mean(axis=(1, 3))
        row[:] = (
            moved.mean(),
            moved.std(),
            grown.std(),
            coarse.min(),
            coarse.max(),
            100.0 * np.count_nonzero(mask) / mask.size,
            edge_length(mask) / mask.shape[1],
        )
    return found


def edge_length(mask: NDArray[Any]) -> int:
    """Return the number of sides between marker pixels and background pixels of a mask (h, w)."""
    across = np.count_nonzero(mask[:, 1:] != mask[:, :-1])
    down = np.count_nonzero(mask[1:] != mask[:-1])
    return int(across + down)


@functools.lru_cache(maxsize=4)
def _of_reference(stored: bytes, shape: tuple[int, ...]) -> tuple[float, Floats]:
    """Return length of edges and area of markers by cell of a reference."""
    reference = np.frombuffer(stored, np.bool_).reshape(shape)
    return edge_length(reference) / _CELLS**2, _cells(reference)


def _cells(mask: NDArray[np.bool_]) -> Floats:
    """Return the number of marker pixels by cell (8, 8)."""
    high, wide = mask.shape[0] // _CELLS, mask.shape[1] // _CELLS
    rows = np.add.reduceat(mask.view(np.uint8), np.arange(0, mask.shape[0], high), 0, np.uint16)
    return np.add.reduceat(rows, np.arange(0, mask.shape[1], wide), 1, np.float64)
