"""Width of a contact."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


# Fraction of the largest traction of a frame below which it does not count as contact.
FAINT = 0.02


def touched_by(traction: NDArray[np.floating[Any]]) -> Mask:
    """Return the mask of touched points (X, Y) for a traction (X, Y, 3)."""
    size = np.linalg.norm(traction, axis=-1)
    return np.asarray(size > FAINT * size.max())


def width_of(touched: Mask, x: Array, y: Array) -> float:
    """Return the diameter of the largest disc within the touched points (X, Y); 0 if none.

    A touched node counts as touched half-way to its neighbours.
    """
    if not touched.any():
        return 0.0
    return 2 * half_width(touched, pixel_edges(x), pixel_edges(y))


def pixel_edges(places: Array) -> Array:
    """Return the edges of the pixels around places (N,): half-way between them (N + 1,)."""
    middle = (places[1:] + places[:-1]) / 2
    first, last = places[0] - (middle[0] - places[0]), places[-1] + (places[-1] - middle[-1])
    return np.concatenate([[first], middle, [last]])


def half_width(mask: Mask, edges_x: Array, edges_y: Array) -> float:
    """Return the radius of the largest disc that fits into a piece.

    Pixels may differ in width: they are resampled to an even grid.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    of_x, of_y = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    return _half_width(
        mask[of_x, of_y].tobytes(),
        edges_x[of_x.start : of_x.stop + 1].tobytes(),
        edges_y[of_y.start : of_y.stop + 1].tobytes(),
    )


# One contact is asked for by several measures, and again by the next frame if it has not changed.
@lru_cache(maxsize=256)
def _half_width(mask: bytes, edges_x: bytes, edges_y: bytes) -> float:
    """Compute `half_width` of a mask without empty rows and columns at its ends."""
    even, steps = [], []
    for edges in (np.frombuffer(edges_x), np.frombuffer(edges_y)):
        low, high = edges[0], edges[-1]
        finest = float((edges[1:] - edges[:-1]).min())
        count = int(min(max(np.ceil(2 * (high - low) / finest), 8), 192))
        steps.append(float(high - low) / count)
        even.append(np.searchsorted(edges, low + steps[-1] * (np.arange(count) + 0.5)) - 1)
    inner = np.zeros((len(even[0]) + 2, len(even[1]) + 2), bool)
    pixels = np.frombuffer(mask, bool).reshape(len(edges_x) // 8 - 1, -1)
    inner[1:-1, 1:-1] = pixels[even[0]][:, even[1]]
    reach = float(ndimage.distance_transform_edt(inner, sampling=steps).max())
    # Distances are to the centre of the nearest pixel outside; the outline is half a pixel nearer.
    return max(reach - min(steps) / 2, min(steps) / 2)
