"""Width of a contact."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


# Fraction of the largest traction of a frame below which it does not count as contact.
FAINT = 0.02
# Most pixels along an axis of the even grid in which a contact is measured.
EVEN_MOST = 192


def touched_by(traction: NDArray[np.floating[Any]]) -> Mask:
    """Return the masks of touched points (..., X, Y) for tractions (..., X, Y, 3)."""
    size = np.linalg.norm(traction, axis=-1)
    return np.asarray(size > FAINT * size.max(axis=(-2, -1), keepdims=True))


def width_of(touched: Mask, x: Array, y: Array) -> float:
    """Return the diameter of the largest disc within touched points (X, Y); 0 if there are none.

    A touched node counts as touched half-way to its neighbours.
    """
    if not touched.any():
        return 0.0
    return 2.0 * float(half_widths(touched[None], pixel_edges(x), pixel_edges(y))[0])


def pixel_edges(places: Array) -> Array:
    """Return the edges of the pixels around places (N,): half-way between them (N + 1,)."""
    middle = (places[1:] + places[:-1]) / 2
    first, last = places[0] - (middle[0] - places[0]), places[-1] + (places[-1] - middle[-1])
    return np.concatenate([[first], middle, [last]])


def half_widths(masks: Mask, edges_x: Array, edges_y: Array) -> Array:
    """Return the radius of the largest disc that fits into each piece (P, X, Y), none empty.

    Pixels may differ in width: they are resampled to an even grid.
    """
    return np.array([_half_width(mask, edges_x, edges_y) for mask in masks])


def _half_width(mask: Mask, edges_x: Array, edges_y: Array) -> float:
    columns, steps = [], []
    for axis, edges in ((1, edges_x), (0, edges_y)):
        here = np.flatnonzero(mask.any(axis=axis))
        inner = edges[here[0] : here[-1] + 2]
        length = inner[-1] - inner[0]
        count = int(np.clip(np.ceil(2 * length / np.diff(inner).min()), 8, EVEN_MOST))
        steps.append(length / count)
        middles = inner[0] + steps[-1] * (np.arange(1, count + 1) - 0.5)
        columns.append(np.searchsorted(edges, middles) - 1)
    # One pixel outside of the piece at each end.
    inside = np.zeros((len(columns[0]) + 2, len(columns[1]) + 2), bool)
    inside[1:-1, 1:-1] = mask[columns[0][:, None], columns[1]]
    reach = float(ndimage.distance_transform_edt(inside, sampling=steps).max())
    # Distances are to the centre of the nearest pixel outside; the outline is half a pixel nearer.
    half = float(min(steps)) / 2
    return max(reach - half, half)
