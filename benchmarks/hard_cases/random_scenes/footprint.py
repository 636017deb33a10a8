"""Overlap of an indenter with the undeformed gel, from geometry, without the solver."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sim.scene import Scene

Array = NDArray[np.float64]

# Number of samples along x and y; later passes cover only the region found in the first.
SAMPLES = 61


@dataclass(frozen=True, slots=True, eq=False)
class Footprint:
    """Depth of the undeformed top inside the indenter, on a raster of the gel."""

    x: Array
    """(X,) [m]."""
    y: Array
    """(Y,) [m]."""
    deep: Array
    """Depth below the undeformed top (X, Y) [m]; below 0 where the indenter is above it, -inf
    outside the indenter."""

    @property
    def deepest(self) -> float:
        """Largest depth [m]; -inf if no part of the indenter is above the gel."""
        return float(self.deep.max())

    @property
    def pixel(self) -> float:
        """Area of a sample [m^2]."""
        return float((self.x[1] - self.x[0]) * (self.y[1] - self.y[0]))

    @property
    def box(self) -> tuple[float, float, float, float] | None:
        """Least and greatest x, least and greatest y of the touched region [m]."""
        rows, columns = np.nonzero(self.deep > 0)
        if not len(rows):
            return None
        return (
            float(self.x[rows.min()]), float(self.x[rows.max()]),
            float(self.y[columns.min()]), float(self.y[columns.max()]),
        )  # fmt: skip

    @property
    def width(self) -> float:
        """Shorter side of that box [m], 0 without contact."""
        box = self.box
        return 0.0 if box is None else min(box[1] - box[0], box[3] - box[2])


@lru_cache(maxsize=64)
def footprint(scene: Scene, tip: tuple[float, float, float]) -> Footprint:
    """Return the footprint with the tip at `tip` [m]."""
    body = scene.body
    depth = max(-tip[2], 1e-2 * body.thickness)
    sides = scene.indenter.bounds_below(1.5 * depth + body.thickness)[:2]
    half = (body.size_x / 2, body.size_y / 2)
    ends = []
    for (low, high), size, at in zip(sides, half, tip[:2], strict=True):
        inside = np.clip([low + at, high + at], -size, size)
        # An indenter next to the gel leaves a strip without width at the rim.
        ends.append((float(inside[0]), max(float(inside[1]), float(inside[0]) + 1e-9)))
    found = _look(scene, tip, ends[0], ends[1])
    for _ in range(2):
        box = found.box
        if box is None:
            top = np.unravel_index(int(np.argmax(found.deep)), found.deep.shape)
            x, y = float(found.x[top[0]]), float(found.y[top[1]])
            box = x, x, y, y
        step = found.x[1] - found.x[0], found.y[1] - found.y[0]
        closer = _look(
            scene,
            tip,
            (max(box[0] - step[0], ends[0][0]), min(box[1] + step[0], ends[0][1])),
            (max(box[2] - step[1], ends[1][0]), min(box[3] + step[1], ends[1][1])),
        )
        if closer.deepest < found.deepest:
            break
        found = closer
    return found


def _look(
    scene: Scene,
    tip: tuple[float, float, float],
    along_x: tuple[float, float],
    along_y: tuple[float, float],
) -> Footprint:
    x, y = np.linspace(*along_x, SAMPLES), np.linspace(*along_y, SAMPLES)
    top = scene.body.heights(x, y)
    reach = max(-tip[2], 0.0) * 1.05 + 2e-2 * scene.body.thickness
    height = scene.indenter.heights((x - tip[0])[:, None], (y - tip[1])[None], reach=reach)
    there = np.isfinite(height) & scene.body.covers(x[:, None], y)
    return Footprint(x, y, np.where(there, top - tip[2] - height, -np.inf))


def half_wall(scene: Scene) -> float:
    """Return half of the indenter's narrowest wall, or its smallest radius [m]; inf without one."""
    indenter = scene.indenter
    if indenter.solid is not None:
        return max(indenter.edge_radius, indenter.solid.spacing)
    radii = [part.values[2] for part in indenter.parts if part.figure == "circle"]
    least = min([indenter.edge_radius_max, *radii])
    return float(least) if least > 0 else math.inf


def inside_by(scene: Scene, tip: tuple[float, float, float], margin: float) -> bool:
    """Return True if the touched region stays `margin` [m] away from every rim of the gel."""
    box = footprint(scene, tip).box
    if box is None:
        return True
    x, y = np.array(box[:2])[:, None], np.array(box[2:])
    return bool(scene.body.from_side(x, y).min() >= margin)
