"""Overlap of the deformed top with the indenter, from dense samples at and between frames.

Nodes are not sufficient: a blade between two rows of nodes contains none of them. The top is
interpolated in two ways, bilinearly between nodes and by a cubic spline; only overlap present in
both counts.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from benchmarks.hard_cases.random_scenes.bounds import half_wall
from sim.result import Result

Array = NDArray[np.float64]
Cells = NDArray[np.int64]

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


def allowed(result: Result, frame: int) -> float:
    """Return the overlap that a mesh may leave in a frame [m]."""
    depth = max(-result.scene.motion.tip[frame][2], 0.0)
    return max(SMALL, min(OF_DEPTH * depth, OF_WALL * half_wall(result.scene)))


def overlap(result: Result, frame: int) -> tuple[float, float]:
    """Return the largest overlap of the deformed top with the indenter in a frame [m].

    The second number is the largest height of the gel above the indenter's lower side there [m].
    """
    scene = result.scene
    tip = np.asarray(scene.motion.tip[frame], float)
    top = deformed(result, frame)
    cells = _near(scene.indenter.distance(top - tip)[0], top)
    on = scene.body.covers(result.surface_x[:, None], result.surface_y)
    whole = on[:-1, :-1] & on[1:, :-1] & on[:-1, 1:] & on[1:, 1:]
    cells = cells[whole[cells[:, 0], cells[:, 1]]]
    if not len(cells):
        return 0.0, 0.0
    u, v = _samples(result, cells)
    flat = _bilinear(top, cells, u, v) - tip
    gap_flat = scene.indenter.distance(flat)[0].reshape(-1)
    deep = np.flatnonzero(gap_flat < 0)
    if not len(deep):
        return 0.0, 0.0
    curved = _spline(result, top, cells, u, v, deep) - tip
    both = np.maximum(gap_flat[deep], scene.indenter.distance(curved)[0])
    limit = min(allowed(result, frame), OF_WALL * half_wall(scene) / 2)
    inside = flat.reshape(-1, 3)[deep][both < -max(limit, SMALL)]
    return float(max(-both.min(), 0.0)), _standing(result, inside, -float(tip[2]))


def crossed(result: Result, frame: int) -> float:
    """Return the deepest path [m] of a node through a wall, from the previous frame to this one.

    Only for a tip that moves straight down or up, and only for nodes that were next to one side of
    a wall and are then next to the opposite side, because such a path cannot lead around the wall.
    """
    indenter, tips = result.scene.indenter, result.scene.motion.tip
    before, after = (np.asarray(tips[index], float) for index in (frame - 1, frame))
    depth = -after[2]
    if np.abs(after[:2] - before[:2]).max() > 1e-12 or depth <= 0:
        return 0.0
    start = (deformed(result, frame - 1) - before).reshape(-1, 3)
    end = (deformed(result, frame) - after).reshape(-1, 3)
    gap_start, normal_start = indenter.distance(start)
    gap_end, normal_end = indenter.distance(end)
    beside = (gap_start > 0) & (gap_end > 0) & (np.minimum(start[:, 2], end[:, 2]) > 0.3 * depth)
    opposite = np.einsum("ij,ij->i", normal_start, normal_end) < -0.3
    some = np.flatnonzero(beside & opposite & np.isfinite(gap_end))
    if not len(some) or not math.isfinite(half_wall(result.scene)):
        return 0.0
    fraction = np.linspace(0.0, 1.0, 33)[:, None, None]
    gap, _ = indenter.distance(start[some] + fraction * (end[some] - start[some]))
    return float(max(-gap.min(), 0.0))


def deformed(result: Result, frame: int) -> Array:
    """Return deformed positions of the nodes of the top (X, Y, 3) [m]."""
    x, y = np.meshgrid(result.surface_x, result.surface_y, indexing="ij")
    rest = np.stack([x, y, result.scene.body.heights(result.surface_x, result.surface_y)], axis=-1)
    placed: Array = rest + result.surface[frame].astype(float)
    return placed


def _near(gap: Array, top: Array) -> Cells:
    """Return cells (C, 2) with a corner nearer to the indenter than their size."""
    least = np.minimum.reduce([gap[:-1, :-1], gap[1:, :-1], gap[:-1, 1:], gap[1:, 1:]])
    one = np.linalg.norm(top[1:, 1:] - top[:-1, :-1], axis=-1)
    other = np.linalg.norm(top[1:, :-1] - top[:-1, 1:], axis=-1)
    return np.argwhere(least < np.maximum(one, other))


def _samples(result: Result, cells: Cells) -> tuple[Array, Array]:
    """Return sample positions within a cell (P,), from 0 to 1, a quarter of half the wall apart."""
    sides = np.diff(result.surface_x)[cells[:, 0]], np.diff(result.surface_y)[cells[:, 1]]
    wanted = float(np.max(sides)) * PER_WALL / half_wall(result.scene)
    count = int(np.clip(math.ceil(wanted), LEAST, MOST))
    place = (np.arange(count) + 0.5) / count
    u, v = np.meshgrid(place, place, indexing="ij")
    return u.ravel(), v.ravel()


def _bilinear(top: Array, cells: Cells, u: Array, v: Array) -> Array:
    """Return the top interpolated bilinearly (C, P, 3) [m]."""
    i, j = cells.T
    corners = np.stack([top[i, j], top[i + 1, j], top[i, j + 1], top[i + 1, j + 1]], axis=1)
    weights = np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v])
    placed: Array = np.einsum("kp,cka->cpa", weights, corners)
    return placed


def _spline(result: Result, top: Array, cells: Cells, u: Array, v: Array, which: Cells) -> Array:
    """Return the top as a cubic spline (W, 3) [m], at samples by their number in (C, P)."""
    cell, sample = np.divmod(which, len(u))
    i, j = cells[cell].T
    x, y = result.surface_x, result.surface_y
    at = x[i] + u[sample] * np.diff(x)[i], y[j] + v[sample] * np.diff(y)[j]
    orders = {"kx": min(3, len(x) - 1), "ky": min(3, len(y) - 1)}
    axes = [RectBivariateSpline(x, y, top[..., axis], **orders).ev(*at) for axis in range(3)]
    return np.stack(axes, axis=-1)


def _standing(result: Result, inside: Array, depth: float) -> float:
    """Return how far down from places (N, 3) the indenter extends, at most [m]."""
    if not len(inside) or depth <= 0:
        return 0.0
    some = inside[np.argsort(-inside[:, 2])[:200]]
    down = np.linspace(0.0, depth, STANDS)[:, None]
    ways = some[None] - down[:, :, None] * np.array([0.0, 0.0, 1.0])
    within = np.logical_and.accumulate(result.scene.indenter.distance(ways)[0] < 0, axis=0)
    return float((down * within).max())
