"""Overlap of the deformed top with the indenter, from dense samples at and between frames.

Nodes are not sufficient: a blade between two rows of nodes contains none of them. The top is
interpolated in two ways, bilinearly between nodes and by a cubic spline; only overlap present in
both counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from benchmarks.hard_cases.random_scenes.footprint import half_wall
from sim.result import Result

Array = NDArray[np.float64]

# Samples per half of the narrowest wall.
PER_WALL = 4
# Maximum and minimum number of samples along an element.
MOST, LEAST = 16, 4
# Overlap that is always allowed [m], due to the mesh.
SMALL = 10e-6
# Allowed overlap as a fraction of the depth, limited by a fraction of half the narrowest wall.
OF_DEPTH, OF_WALL = 0.05, 0.5
# Allowed height of gel above the indenter's lower side, over the depth, where gel is inside it:
# above this, the indenter has passed through the gel.
THROUGH = 0.7
# Number of heights sampled to find how far down the indenter goes.
STANDS = 24


@dataclass(frozen=True, slots=True)
class Overlap:
    """Overlap in one frame."""

    normal: float
    """Largest distance inside the indenter, to its nearest side [m]."""
    upright: float
    """Largest height of the gel above the indenter's lower side there [m]."""


def allowed(result: Result, frame: int) -> float:
    """Return the overlap that a mesh may leave in a frame [m]."""
    depth = max(-result.scene.motion.tip[frame][2], 0.0)
    return max(SMALL, min(OF_DEPTH * depth, OF_WALL * half_wall(result.scene)))


def overlap(result: Result, frame: int) -> Overlap:
    """Return the overlap of the deformed top with the indenter in a frame."""
    scene = result.scene
    tip = np.asarray(scene.motion.tip[frame], float)
    top = _top(result, frame)
    gap, _ = scene.indenter.distance(top - tip)
    cells = _near(gap, top)
    cells = cells[_on_body(result)[cells[:, 0], cells[:, 1]]]
    if not len(cells):
        return Overlap(0.0, 0.0)
    u, v = _samples(result, cells)
    flat = _bilinear(top, cells, u, v) - tip
    gap_flat, _ = scene.indenter.distance(flat)
    deep = np.flatnonzero(gap_flat < 0)
    if not len(deep):
        return Overlap(0.0, 0.0)
    curved = _spline(result, top, cells, u, v, deep) - tip
    gap_curved, _ = scene.indenter.distance(curved)
    both = np.maximum(gap_flat.reshape(-1)[deep], gap_curved)
    normal = float(max(-both.min(), 0.0))
    limit = min(allowed(result, frame), OF_WALL * half_wall(scene) / 2)
    inside = flat.reshape(-1, 3)[deep][both < -max(limit, SMALL)]
    return Overlap(normal, _standing(result, inside, -float(tip[2])))


def crossed(result: Result, frame: int) -> float:
    """Return the deepest path [m] of a node through a wall, from the previous frame to this one.

    Only for a tip that moves straight down or up, and only for nodes that were next to one side of
    a wall and are then next to the opposite side, because such a path cannot lead around the wall.
    """
    scene = result.scene
    before, after = (np.asarray(scene.motion.tip[index], float) for index in (frame - 1, frame))
    depth = -after[2]
    if np.abs(after[:2] - before[:2]).max() > 1e-12 or depth <= 0:
        return 0.0
    wall = half_wall(scene)
    start, end = _top(result, frame - 1) - before, _top(result, frame) - after
    start, end = start.reshape(-1, 3), end.reshape(-1, 3)
    gap_start, normal_start = scene.indenter.distance(start)
    gap_end, normal_end = scene.indenter.distance(end)
    beside = (gap_start > 0) & (gap_end > 0) & (np.minimum(start[:, 2], end[:, 2]) > 0.3 * depth)
    opposite = np.einsum("ij,ij->i", normal_start, normal_end) < -0.3
    some = np.flatnonzero(beside & opposite & np.isfinite(gap_end))
    if not len(some) or not math.isfinite(wall):
        return 0.0
    fraction = np.linspace(0.0, 1.0, 33)[:, None, None]
    way = start[some] + fraction * (end[some] - start[some])
    gap, _ = scene.indenter.distance(way)
    return float(max(-gap.min(), 0.0))


def _top(result: Result, frame: int) -> Array:
    """Return deformed positions of the nodes of the top (X, Y, 3) [m]."""
    x, y = np.meshgrid(result.surface_x, result.surface_y, indexing="ij")
    rest = np.stack([x, y, result.scene.body.heights(result.surface_x, result.surface_y)], axis=-1)
    placed: Array = rest + result.surface[frame].astype(float)
    return placed


def _near(gap: Array, top: Array) -> NDArray[np.int64]:
    """Return cells (C, 2) with a corner nearer to the indenter than their size."""
    least = np.minimum.reduce([gap[:-1, :-1], gap[1:, :-1], gap[:-1, 1:], gap[1:, 1:]])
    one = np.linalg.norm(top[1:, 1:] - top[:-1, :-1], axis=-1)
    other = np.linalg.norm(top[1:, :-1] - top[:-1, 1:], axis=-1)
    return np.argwhere(least < np.maximum(one, other))


def _on_body(result: Result) -> NDArray[np.bool_]:
    """Return True for cells (X - 1, Y - 1) whose corners are all on the footprint."""
    on = result.scene.body.covers(result.surface_x[:, None], result.surface_y)
    return np.asarray(on[:-1, :-1] & on[1:, :-1] & on[:-1, 1:] & on[1:, 1:])


def _samples(result: Result, cells: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return sample positions within a cell (P,), from 0 to 1, a quarter of half the wall apart."""
    size = max(
        float(np.diff(result.surface_x)[cells[:, 0]].max()),
        float(np.diff(result.surface_y)[cells[:, 1]].max()),
    )
    wanted = size * PER_WALL / half_wall(result.scene)
    count = int(np.clip(math.ceil(wanted), LEAST, MOST))
    place = (np.arange(count) + 0.5) / count
    u, v = np.meshgrid(place, place, indexing="ij")
    return u.ravel(), v.ravel()


def _bilinear(top: Array, cells: NDArray[np.int64], u: Array, v: Array) -> Array:
    """Return the top interpolated bilinearly (C, P, 3) [m]."""
    i, j = cells.T
    corners = [top[i, j], top[i + 1, j], top[i, j + 1], top[i + 1, j + 1]]
    weights = [(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v]
    pieces = [
        weight[:, None] * corner[:, None] for weight, corner in zip(weights, corners, strict=True)
    ]
    placed: Array = sum(pieces[1:], pieces[0])
    return placed


def _spline(
    result: Result,
    top: Array,
    cells: NDArray[np.int64],
    u: Array,
    v: Array,
    which: NDArray[np.int64],
) -> Array:
    """Return the top as a cubic spline (W, 3) [m], at samples by their number in (C, P)."""
    cell, sample = np.divmod(which, len(u))
    i, j = cells[cell].T
    x, y = result.surface_x, result.surface_y
    at_x = x[i] + u[sample] * np.diff(x)[i]
    at_y = y[j] + v[sample] * np.diff(y)[j]
    order = min(3, len(x) - 1), min(3, len(y) - 1)
    read = [
        RectBivariateSpline(x, y, top[..., axis], kx=order[0], ky=order[1]).ev(at_x, at_y)
        for axis in range(3)
    ]
    return np.stack(read, axis=-1)


def _standing(result: Result, inside: Array, depth: float) -> float:
    """Return how far down from places (N, 3) the indenter extends, at most [m]."""
    if not len(inside) or depth <= 0:
        return 0.0
    some = inside[np.argsort(-inside[:, 2])[:200]]
    down = np.linspace(0.0, depth, STANDS)[:, None]
    ways = some[None] - down[:, :, None] * np.array([0.0, 0.0, 1.0])
    gap, _ = result.scene.indenter.distance(ways)
    within = np.logical_and.accumulate(gap < 0, axis=0)
    return float((down * within).max())
