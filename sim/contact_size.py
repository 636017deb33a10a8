"""Width of a contact."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

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
    """Return `widths_of` of one contact (X, Y)."""
    return float(widths_of(touched[None], x, y)[0])


def widths_of(touched: Mask, x: Array, y: Array) -> Array:
    """Return the diameters of the largest discs within touched points (F, X, Y); 0 if none (F,).

    A touched node counts as touched half-way to its neighbours.
    """
    width, some = np.zeros(len(touched)), touched.any(axis=(1, 2))
    if some.any():
        width[some] = 2 * half_widths(touched[some], pixel_edges(x), pixel_edges(y))
    return width


def pixel_edges(places: Array) -> Array:
    """Return the edges of the pixels around places (N,): half-way between them (N + 1,)."""
    middle = (places[1:] + places[:-1]) / 2
    first, last = places[0] - (middle[0] - places[0]), places[-1] + (places[-1] - middle[-1])
    return np.concatenate([[first], middle, [last]])


# Most pixels that are looked at together.
PIXELS_MOST = 500_000


def half_widths(masks: Mask, edges_x: Array, edges_y: Array) -> Array:
    """Return the radius of the largest disc that fits into each piece (P, X, Y), none empty.

    Pixels may differ in width: they are resampled to an even grid.
    """
    columns, steps = [], []
    for axis, edges in ((2, edges_x), (1, edges_y)):
        here = np.asarray(masks.any(axis=axis))
        first, past = here.argmax(axis=1), here.shape[1] - here[:, ::-1].argmax(axis=1)
        low, high = edges[first], edges[past]
        index, place = np.arange(here.shape[1]), np.arange(EVEN_MOST + 2) - 0.5
        inner = (index >= first[:, None]) & (index < past[:, None])
        finest = np.where(inner, np.diff(edges), np.inf).min(axis=1)
        count = np.clip(np.ceil(2 * (high - low) / finest), 8, EVEN_MOST)
        place = place[: int(count.max()) + 2]
        steps.append((high - low) / count)
        column = np.searchsorted(edges, low[:, None] + steps[-1][:, None] * place) - 1
        # One pixel outside of the piece at each end, and further ones where others have more.
        columns.append(np.where((place > 0) & (place < count[:, None]), column, len(index)))
    if len(masks) > 1 and len(masks) * columns[0].shape[1] * columns[1].shape[1] > PIXELS_MOST:
        halves = np.array_split(masks, 2)
        return np.concatenate([half_widths(one, edges_x, edges_y) for one in halves])
    framed = np.pad(masks, ((0, 0), (0, 1), (0, 1)))
    number = np.arange(len(masks))
    inside = framed[number[:, None, None], columns[0][:, :, None], columns[1][:, None]]
    along = [
        np.square(_to_outside(inside, axis) * steps[axis - 1][:, None, None]) for axis in (1, 2)
    ]
    # The nearest pixel outside is no farther than along an axis: few pixels may have the most.
    bound = np.minimum(*along)
    best = np.zeros(len(masks))
    chosen = (
        number,
        *np.unravel_index(bound.reshape(len(masks), -1).argmax(axis=1), inside.shape[1:]),
    )
    for _look in range(2):
        piece, i, j = chosen
        aside = (np.arange(inside.shape[2]) - j[:, None]) * steps[1][piece][:, None]
        np.maximum.at(best, piece, (along[0][piece, i] + np.square(aside)).min(axis=1))
        chosen = np.nonzero(bound > best[:, None, None])
    reach, half = np.sqrt(best), np.minimum(*steps) / 2
    # Distances are to the centre of the nearest pixel outside; the outline is half a pixel nearer.
    return np.asarray(np.maximum(reach - half, half))


def _to_outside(inside: Mask, axis: int) -> NDArray[np.int64]:
    """Return the number of pixels (P, X, Y) to the nearest one along an axis that is not inside."""
    inside = np.moveaxis(inside, axis, 1)
    index = np.arange(inside.shape[1])[:, None]
    before = np.maximum.accumulate(np.where(inside, 0, index), axis=1)
    after = np.where(inside, len(index), index)[:, ::-1]
    after = np.minimum.accumulate(after, axis=1)[:, ::-1]
    return np.moveaxis(np.minimum(index - before, after - index), 1, axis)
