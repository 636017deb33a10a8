"""Overlap of the deformed top with the indenter, from dense samples at and between frames.

Nodes are not sufficient: a blade between two rows of nodes contains none of them. The top is
interpolated in two ways, bilinearly between nodes and by a cubic spline; only overlap present in
both counts.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from benchmarks.hard_cases.random_scenes.bounds import half_wall
from sim.result import Result

Array = NDArray[np.float64]

# Samples per half of the narrowest wall, and their least and largest number along an element.
PER_WALL, LEAST, MOST = 4, 4, 16
# Overlap that is always allowed [m], due to the mesh.
SMALL = 10e-6
# Allowed overlap as a fraction of the depth, limited by a fraction of half the narrowest wall.
OF_DEPTH, OF_WALL = 0.05, 0.5
# Allowed height of gel above the indenter's lower side, over the depth, where gel is inside it:
# above this, the indenter has passed through the gel.
THROUGH = 0.7


def allowed(result: Result, frame: int) -> float:
    """Return the overlap that a mesh may leave in a frame [m]."""
    depth = max(-result.scene.motion.tip[frame][2], 0.0)
    return max(SMALL, min(OF_DEPTH * depth, OF_WALL * half_wall(result.scene)))


def overlap(result: Result, frame: int) -> tuple[float, float]:
    """Return the largest overlap of the deformed top with the indenter in a frame [m].

    The second number is the largest height of the gel above the indenter's lower side there [m].
    """
    scene, tip = result.scene, result.scene.motion.tip[frame]
    top = deformed(result, frame) - tip
    on = scene.body.covers(result.surface_x[:, None], result.surface_y)
    near = _of_cells(np.minimum, scene.indenter.distance(top)[0]) < np.maximum(
        np.linalg.norm(top[1:, 1:] - top[:-1, :-1], axis=-1),
        np.linalg.norm(top[1:, :-1] - top[:-1, 1:], axis=-1),
    )
    cells = np.argwhere(near & _of_cells(np.logical_and, on))
    if not len(cells):
        return 0.0, 0.0
    x, y = _samples(result, cells)
    flat = _interpolated(result, top, x, y, order=1)
    gap = scene.indenter.distance(flat)[0]
    deep = gap < 0
    if not deep.any():
        return 0.0, 0.0
    curved = _interpolated(result, top, x[deep], y[deep], order=3)
    both = np.maximum(gap[deep], scene.indenter.distance(curved)[0])
    limit = min(allowed(result, frame), OF_WALL * half_wall(scene) / 2)
    inside = flat[deep][both < -max(limit, SMALL)]
    # Where gel is inside the indenter, it is above the indenter's lower side.
    lower = scene.indenter.heights(inside[:, 0], inside[:, 1], reach=max(-tip[2], SMALL))
    above = float((inside[:, 2] - lower).max(initial=0.0))
    return float(max(-both.min(), 0.0)), above


def crossed(result: Result, frame: int) -> float:
    """Return the deepest path [m] of a node through a wall, from the previous frame to this one.

    Only for a tip that moves straight down or up, and only for nodes that were next to one side of
    a wall and are then next to the opposite side, because such a path cannot lead around the wall.
    """
    indenter = result.scene.indenter
    before, after = (np.array(result.scene.motion.tip[index]) for index in (frame - 1, frame))
    depth = -after[2]
    if np.abs(after[:2] - before[:2]).max() > 1e-12 or depth <= 0:
        return 0.0
    start = (deformed(result, frame - 1) - before).reshape(-1, 3)
    end = (deformed(result, frame) - after).reshape(-1, 3)
    gap_start, normal_start = indenter.distance(start)
    gap_end, normal_end = indenter.distance(end)
    beside = (gap_start > 0) & (gap_end > 0) & (np.minimum(start[:, 2], end[:, 2]) > 0.3 * depth)
    opposite = (normal_start * normal_end).sum(axis=1) < -0.3
    some = beside & opposite & np.isfinite(gap_end)
    fraction = np.linspace(0.0, 1.0, 33)[:, None, None]
    gap, _ = indenter.distance(start[some] + fraction * (end[some] - start[some]))
    return float(-gap.min(initial=0.0))


def deformed(result: Result, frame: int) -> Array:
    """Return deformed positions of the nodes of the top (X, Y, 3) [m]."""
    x, y = np.meshgrid(result.surface_x, result.surface_y, indexing="ij")
    rest = np.stack([x, y, result.scene.body.heights(result.surface_x, result.surface_y)], axis=-1)
    return np.asarray(rest + result.surface[frame].astype(float))


def _of_cells(join: np.ufunc, values: NDArray[Any]) -> NDArray[Any]:
    """Return values of the nodes (X, Y), joined from the corners of each cell (X - 1, Y - 1)."""
    rows = join(values[:-1], values[1:])
    return np.asarray(join(rows[:, :-1], rows[:, 1:]))


def _samples(result: Result, cells: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return x and y of samples in each cell (C * P,) [m], a quarter of half the wall apart."""
    sides = [np.diff(axis) for axis in (result.surface_x, result.surface_y)]
    largest = max(side[index].max() for side, index in zip(sides, cells.T, strict=True))
    count = math.ceil(np.clip(largest * PER_WALL / half_wall(result.scene), LEAST, MOST))
    place = (np.arange(count) + 0.5) / count
    i, j = cells.T[..., None, None]
    x = result.surface_x[i] + place[:, None] * sides[0][i]
    y = result.surface_y[j] + place * sides[1][j]
    x, y = np.broadcast_arrays(x, y)
    return x.ravel(), y.ravel()


def _interpolated(result: Result, top: Array, x: Array, y: Array, order: int) -> Array:
    """Return positions (S, 3) [m] of the top at x and y (S,) [m], by a spline of this order."""
    axes = result.surface_x, result.surface_y
    orders = {f"k{name}": min(order, len(axis) - 1) for name, axis in zip("xy", axes, strict=True)}
    splines = [RectBivariateSpline(*axes, top[..., axis], **orders) for axis in range(3)]
    return np.stack([spline.ev(x, y) for spline in splines], axis=-1)
