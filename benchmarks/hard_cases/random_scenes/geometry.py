"""Where indenter and gel overlap: the undeformed gel, the deformed top, and between two frames.

Nodes of the top are not sufficient: a blade between two rows of nodes contains none of them. The
top is interpolated in two ways, bilinearly between nodes and by a cubic spline; only overlap
present in both counts.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.interpolate import RectBivariateSpline

from benchmarks.hard_cases.laws import Array
from sim.result import Result
from sim.scene import Point, Scene

# Number of samples along x and y; later passes cover only the region of the one before.
SAMPLES = 61
# Samples per half of the narrowest wall, and their least and largest number along an element.
PER_WALL, LEAST, MOST = 4, 4, 16
# Overlap that is always allowed [m], due to the mesh.
SMALL = 10e-6
# Allowed overlap as a fraction of the depth, limited by a fraction of half the narrowest wall.
OF_DEPTH, OF_WALL = 0.05, 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Footprint:
    """Depth of the undeformed top inside the indenter, on a raster of the gel."""

    axes: tuple[Array, Array]
    """x (X,) and y (Y,) [m]."""
    deep: Array
    """Depth below the undeformed top (X, Y) [m]; below 0 where the indenter is above it, -inf
    outside the indenter."""

    @property
    def deepest(self) -> float:
        """Largest depth [m]; -inf if no part of the indenter is above the gel."""
        return float(self.deep.max())

    @property
    def box(self) -> list[Array]:
        """Least and greatest x, then y [m], of the touched region, or of the deepest places."""
        touched = self.deep > 0 if self.deepest > 0 else self.deep == self.deepest
        places = zip(self.axes, np.nonzero(touched), strict=True)
        return [axis[[index.min(), index.max()]] for axis, index in places]


@lru_cache(maxsize=64)
def footprint(scene: Scene, tip: Point) -> Footprint:
    """Return the footprint with the tip at `tip` [m]."""
    body = scene.body
    depth = max(-tip[2], 1e-2 * body.thickness)
    sides = scene.indenter.bounds_below(1.5 * depth + body.thickness)[:2]
    halves = body.size_x / 2, body.size_y / 2
    whole = [
        np.clip(np.add(side, at), -half, half)
        for side, at, half in zip(sides, tip[:2], halves, strict=True)
    ]
    reach = max(-tip[2], 0.0) * 1.05 + 2e-2 * body.thickness
    region = whole
    for _ in range(3):
        # An indenter next to the gel leaves a strip without width at the rim.
        x, y = (np.linspace(low, max(high, low + 1e-9), SAMPLES) for low, high in region)
        height = scene.indenter.heights((x - tip[0])[:, None], y - tip[1], reach=reach)
        there = np.isfinite(height) & body.covers(x[:, None], y)
        deep = np.where(there, body.heights(x, y) - tip[2] - height, -np.inf)
        raster = Footprint((x, y), deep)
        region = [
            np.clip((low - axis[1] + axis[0], high + axis[1] - axis[0]), *ends)
            for (low, high), axis, ends in zip(raster.box, raster.axes, whole, strict=True)
        ]
    return raster


def half_wall(scene: Scene) -> float:
    """Return half of the indenter's narrowest wall, or its smallest radius [m]; inf without one."""
    indenter = scene.indenter
    if indenter.solid is not None:
        return max(indenter.edge_radius, indenter.solid.spacing)
    radii = [part.values[2] for part in indenter.parts if part.figure == "circle"]
    return float(min([indenter.edge_radius_max, *radii])) or math.inf


def inside_by(scene: Scene, tip: Point, margin: float) -> bool:
    """Return True if the touched region stays `margin` [m] away from every rim of the gel."""
    raster = footprint(scene, tip)
    x, y = raster.box
    return raster.deepest <= 0 or bool(scene.body.from_side(x[:, None], y).min() >= margin)


def allowed(result: Result, frame: int) -> float:
    """Return the overlap that a mesh may leave in a frame [m]."""
    depth = max(-result.scene.motion.tip[frame][2], 0.0)
    return max(SMALL, min(OF_DEPTH * depth, OF_WALL * half_wall(result.scene)))


def overlap(result: Result, frame: int) -> tuple[float, float]:
    """Return the largest overlap of the deformed top with the indenter in a frame [m].

    The second number is the largest height of the gel above the indenter's lower side there [m].
    """
    scene, tip = result.scene, result.scene.motion.tip[frame]
    x, y = result.surface_x, result.surface_y
    largest = max(np.diff(x).max(), np.diff(y).max())
    count = math.ceil(np.clip(largest * PER_WALL / half_wall(scene), LEAST, MOST))
    on = scene.body.covers(x[:, None], y)
    whole = on[:-1, :-1] & on[1:, :-1] & on[:-1, 1:] & on[1:, 1:]
    cells = np.kron(whole, np.ones((count, count), bool))
    flat, curved = (_refined(result, frame, count, order)[cells] - tip for order in (1, 3))
    gap = scene.indenter.distance(flat)[0]
    deep = gap < 0
    flat, gap = flat[deep], np.maximum(gap[deep], scene.indenter.distance(curved[deep])[0])
    limit = min(allowed(result, frame), OF_WALL * half_wall(scene) / 2)
    inside = flat[gap < -max(limit, SMALL)]
    # Where gel is inside the indenter, it is above the indenter's lower side.
    lower = scene.indenter.heights(inside[:, 0], inside[:, 1], reach=max(-tip[2], SMALL))
    return float(-gap.min(initial=0.0)), float((inside[:, 2] - lower).max(initial=0.0))


def deformed(result: Result, frame: int) -> Array:
    """Return deformed positions of the nodes of the top (X, Y, 3) [m]."""
    x, y = np.meshgrid(result.surface_x, result.surface_y, indexing="ij")
    rest = np.stack([x, y, result.scene.body.heights(result.surface_x, result.surface_y)], axis=-1)
    return np.asarray(rest + result.surface[frame].astype(float))


def _refined(result: Result, frame: int, count: int, order: int) -> Array:
    """Return `deformed` at `count` samples along each element, by splines of this order."""
    axes, top = (result.surface_x, result.surface_y), deformed(result, frame)
    place = (np.arange(count) + 0.5) / count
    fine = [(axis[:-1, None] + place * np.diff(axis)[:, None]).ravel() for axis in axes]
    kx, ky = (min(order, len(axis) - 1) for axis in axes)
    splines = [RectBivariateSpline(*axes, top[..., axis], kx=kx, ky=ky) for axis in range(3)]
    return np.stack([spline(*fine) for spline in splines], axis=-1)
