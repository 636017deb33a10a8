"""Where a distance on a grid has a given value, as triangles that keep sharp edges."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sim.indenters.field import Grid

Array = NDArray[np.float64]
Whole = NDArray[np.int64]

AROUND = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
"""The four cells around an edge of the grid, as steps back along the two other axes."""
PASSES = 3
"""Looks at every edge that is crossed."""
SHARP = 0.01
"""Directions that the planes of a cell hold less firmly than this, against the firmest, are
free: the normals lie within some 10 degrees of the others' plane."""


def level_surface(
    values: Array, grid: Grid, function: Callable[[Array], tuple[Array, Array]]
) -> tuple[Array, NDArray[np.int32]]:
    """Vertices (V, 3) [m] and triangles (F, 3) of the surface where `values` [m] pass through 0.

    Dual contouring (Ju et al. 2002): every cell that is crossed gets one vertex, where the planes
    in which the surface crosses the cell's sides meet; so the corners and edges of a body with flat
    faces are exact. Triangles are neither oriented nor always apart, which distances do not mind.

    Args:
        values: A distance at the nodes.
        grid: The nodes.
        function: The distance (N,) and its gradient (N, 3) at places (N, 3) near the surface.
    """
    lower, axis = _crossed_edges(values <= 0)
    upper = lower + np.eye(3, dtype=np.int64)[axis]
    crossing, normal, above = _crossings(
        (grid.places(lower), values[tuple(lower.T)]),
        (grid.places(upper), values[tuple(upper.T)]),
        function,
    )
    cells = _cells_around(lower, axis, grid)
    known = cells >= 0
    number, vertex = np.unique(cells[known], return_inverse=True)
    edge = np.nonzero(known)[0]
    offset = np.einsum("ij,ij->i", normal, crossing) - above
    corner = grid.places(np.column_stack(np.unravel_index(number, grid.shape)))
    vertices = _where_planes_meet(vertex, normal[edge], offset[edge], crossing[edge], len(number))
    # Planes may meet a little outside of their cell, and there is the corner then.
    vertices = np.clip(vertices, corner - grid.spacing, corner + 2 * grid.spacing)

    quads = np.full(cells.shape, -1)
    quads[known] = vertex
    quads = quads[known.all(axis=1)]
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return vertices, faces.astype(np.int32)


def _crossed_edges(inside: NDArray[np.bool_]) -> tuple[Whole, Whole]:
    """Lower node (N, 3) and axis (N,) of every edge of the grid with one end inside."""
    lower, axes = [], []
    for axis in range(3):
        found = np.argwhere(np.diff(inside, axis=axis))
        lower.append(found)
        axes.append(np.full(len(found), axis))
    return np.concatenate(lower), np.concatenate(axes)


def _crossings(
    lower: tuple[Array, Array],
    upper: tuple[Array, Array],
    function: Callable[[Array], tuple[Array, Array]],
) -> tuple[Array, Array, Array]:
    """Where edges are crossed (N, 3), the gradient there, and what the function still is there.

    The ends are given with the function's values. They are drawn together by false position; what
    is left of the way is along the gradient, and no matter on a plane.
    """
    (low, at_low), (high, at_high) = lower, upper
    for turn in range(PASSES):
        share = at_low / (at_low - at_high)
        place = low + share[:, None] * (high - low)
        value, gradient = function(place)
        if turn < PASSES - 1:
            like_low = (value > 0) == (at_low > 0)
            low, high = (
                np.where(like_low[:, None], place, low),
                np.where(like_low[:, None], high, place),
            )
            at_low, at_high = np.where(like_low, value, at_low), np.where(like_low, at_high, value)
    return place, gradient, value


def _cells_around(lower: Whole, axis: Whole, grid: Grid) -> Whole:
    """Numbers of the four cells around edges (N, 4), by their lowest node; -1 where none is."""
    cells = np.repeat(lower[:, None, :], 4, axis=1)
    every = np.arange(len(lower))
    for turn in (0, 1):
        cells[every, :, (axis + 1 + turn) % 3] -= AROUND[:, turn]
    there = ((cells >= 0) & (cells < np.array(grid.shape) - 1)).all(axis=2)
    numbers = np.full(there.shape, -1)
    numbers[there] = np.ravel_multi_index(tuple(cells[there].T), grid.shape)
    return numbers


def _where_planes_meet(
    vertex: Whole, normal: Array, offset: Array, crossing: Array, count: int
) -> Array:
    """The point (count, 3) of each vertex that is nearest to its planes, normal . x = offset.

    The least squares are solved from the mean of the crossings, and only along directions that
    the planes hold.
    """

    def summed(values: Array) -> Array:
        total: Array = np.bincount(vertex, values, count).astype(np.float64)
        return total

    planes = summed(np.ones(len(vertex)))
    mean = np.stack([summed(crossing[:, i]) / planes for i in range(3)], axis=1)
    short = offset - np.einsum("ij,ij->i", normal, mean[vertex])
    pull = np.stack([summed(normal[:, i] * short) for i in range(3)], axis=1)
    squares = np.empty((count, 3, 3))
    for i in range(3):
        for j in range(i + 1):
            squares[:, i, j] = squares[:, j, i] = summed(normal[:, i] * normal[:, j])
    size, along = np.linalg.eigh(squares)
    firm = size > SHARP * size[:, 2:]
    step = np.einsum("nij,ni->nj", along, pull) * firm / np.where(firm, size, 1.0)
    met: Array = mean + np.einsum("nij,nj->ni", along, step)
    return met
