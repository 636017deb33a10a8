"""The exact signed distance from a rounded path, by a loop over rows of numbers."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sim.indenters.outline import POINT, Pair, fitted

Array = NDArray[np.float64]

LINE, ARC, CORNER = 0, 1, 2
"""Kinds of row."""
ROW = 7
"""Numbers in a row."""


@lru_cache(maxsize=256)
def rows(values: tuple[float, ...], radius: float) -> Array:
    """The path with its convex corners rounded to `radius` [m], as numbers to loop over.

    Rows are (kind, u, v, direction u, direction v, size, cosine). A line: its start, its direction
    and its length. An arc: its centre, the direction of its middle, its radius (below 0 when
    concave) and the cosine of half its angle. A corner: its place and the mean outward normal.
    The corners come last.

    Raises:
        SceneError: The arcs do not fit.
    """
    path = fitted(values, radius)
    table: list[tuple[float, ...]] = []
    for piece in path:
        along = piece.tangent(end=False)
        if piece.bulge:
            sign = math.copysign(1.0, piece.bulge)
            middle = _rotated((sign * along[1], -sign * along[0]), piece.angle / 2)
            cosine = math.cos(piece.angle / 2)
            table.append((ARC, *piece.centre, *middle, piece.radius, cosine))
        else:
            table.append((LINE, *piece.start, *along, piece.length, 0.0))
    for index, piece in enumerate(path):
        before, after = path[index - 1].tangent(end=True), piece.tangent(end=False)
        mean = before[1] + after[1], -before[0] - after[0]
        length = math.hypot(*mean)
        table.append((CORNER, *piece.start, mean[0] / length, mean[1] / length, 0.0, 0.0))
    result = np.array(table)
    result.flags.writeable = False
    return result


def distance(table: Array, u: Array, v: Array) -> tuple[Array, Array, Array]:
    """Signed distance from the path (N,), and its gradient in u and in v.

    A corner counts only where it is nearer than every line and arc by more than rounding: where
    pieces meet smoothly it then never decides, so its ill-conditioned direction is never used.
    """
    gap = np.full(u.shape, np.inf)
    normal_u, normal_v = np.ones_like(u), np.zeros_like(u)
    for kind, at_u, at_v, along_u, along_v, size, cosine in table:
        from_u, from_v = u - at_u, v - at_v
        if kind == LINE:
            share = along_u * from_u + along_v * from_v
            here = along_v * from_u - along_u * from_v
            nearer = (share >= 0) & (share <= size) & (np.abs(here) < np.abs(gap))
            here_u, here_v = np.full_like(u, along_v), np.full_like(u, -along_u)
        else:
            length = np.hypot(from_u, from_v)
            span = np.where(length > 0, length, 1.0)
            facing = along_u * from_u + along_v * from_v
            if kind == ARC:
                sign = np.copysign(1.0, size)
                here = sign * length - size
                nearer = (facing >= cosine * length) & (np.abs(here) < np.abs(gap))
                here_u = np.where(length > 0, sign * from_u / span, along_u)
                here_v = np.where(length > 0, sign * from_v / span, along_v)
            else:
                side = np.where(facing < 0, -1.0, 1.0)
                here = side * length
                nearer = length < np.abs(gap) - POINT
                apart = length > POINT
                here_u = np.where(apart, side * from_u / span, along_u)
                here_v = np.where(apart, side * from_v / span, along_v)
        gap = np.where(nearer, here, gap)
        normal_u, normal_v = np.where(nearer, here_u, normal_u), np.where(nearer, here_v, normal_v)
    return gap, normal_u, normal_v


def _rotated(pair: Pair, angle: float) -> Pair:
    cosine, sine = math.cos(angle), math.sin(angle)
    return cosine * pair[0] - sine * pair[1], sine * pair[0] + cosine * pair[1]
