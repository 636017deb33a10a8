"""The contour of an image at a threshold, to a fraction of a pixel, and the distance to it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

NEAREST = 4
"""Segments looked at for each point: the nearest middle need not be that of the nearest segment."""
_TOP, _RIGHT, _BOTTOM, _LEFT = range(4)


def contour(level: Array) -> Array:
    """Segments (n, 2, 2) of the zero contour of `level` (R, C), as (column, row) of their ends.

    Marching squares: values lie at pixel centres (whole numbers) and are linear along the lines
    between neighbours. A cell with two opposite corners inside is joined or split by the mean of
    its corners.
    """
    row, column = np.indices(level.shape, dtype=float)
    across = _crossings(level[:, :-1], level[:, 1:])
    down = _crossings(level[:-1], level[1:])
    on_rows = np.stack([column[:, :-1] + across, row[:, :-1]], axis=-1)
    on_columns = np.stack([column[:-1], row[:-1] + down], axis=-1)
    crossed = np.stack(
        [
            np.isfinite(across[:-1]),
            np.isfinite(down[:, 1:]),
            np.isfinite(across[1:]),
            np.isfinite(down[:, :-1]),
        ],
        axis=-1,
    )
    cells = np.nonzero(crossed.any(axis=-1))
    edges = crossed[cells]
    r, c = cells
    ends = np.stack([on_rows[r, c], on_columns[r, c + 1], on_rows[r + 1, c], on_columns[r, c]], 1)
    saddle = edges.all(axis=-1)
    plain = np.nonzero(~saddle)[0]
    first = edges[plain].argmax(axis=1)
    last = 3 - edges[plain, ::-1].argmax(axis=1)
    segments = [np.stack([ends[plain, first], ends[plain, last]], axis=1)]
    mean = (level[:-1, :-1] + level[:-1, 1:] + level[1:, :-1] + level[1:, 1:])[cells]
    joined = (mean < 0) == (level[:-1, :-1][cells] < 0)
    # The middle belongs to the upper left corner and the one across: the others are cut off.
    for which, pairs in (
        (saddle & joined, ((_TOP, _RIGHT), (_BOTTOM, _LEFT))),
        (saddle & ~joined, ((_TOP, _LEFT), (_BOTTOM, _RIGHT))),
    ):
        segments += [ends[which][:, pair] for pair in pairs]
    return np.concatenate(segments)


def distance_to(segments: Array, points: Array, limit: float) -> Array:
    """Distance (m,) from points (m, 2) to the nearest of the segments (n, 2, 2), `limit` at most.

    Exact where no segment is longer than what is between its neighbours, as those of a contour are.
    """
    found = np.full(len(points), limit)
    if not len(segments):
        return found
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    length = np.hypot(along[:, 0], along[:, 1])
    near, index = cKDTree(start + along / 2).query(
        points, k=NEAREST, distance_upper_bound=limit + length.max() / 2
    )
    for rank in range(NEAREST):
        inside = np.nonzero(np.isfinite(near[:, rank]))[0]
        chosen = index[inside, rank]
        offset = points[inside] - start[chosen]
        size = np.maximum(length[chosen] ** 2, np.finfo(float).tiny)
        share = np.clip((offset * along[chosen]).sum(axis=1) / size, 0, 1)
        beside = offset - share[:, None] * along[chosen]
        found[inside] = np.minimum(found[inside], np.hypot(beside[:, 0], beside[:, 1]))
    return found


def _crossings(before: Array, after: Array) -> Array:
    """Where between two neighbours the sign changes, as a share of the way; NaN where it does not.

    0 counts as outside.
    """
    crosses = (before < 0) != (after < 0)
    change = np.where(crosses, before - after, 1.0)
    return np.where(crosses, before / change, np.nan)
