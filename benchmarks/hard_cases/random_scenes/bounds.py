"""Bounds of a force from geometry and mechanics, without the solver: outside, it is far wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from sim.errors import SceneError, SimulationDiverged
from sim.layer import Layer
from sim.scene import Motion, Scene
from sim.tiers import simulate_many

Array = NDArray[np.float64]
Point = tuple[float, float, float]

# Number of samples along x and y; later passes cover only the region found in the first.
SAMPLES = 61
# Required fraction of the lower bound: a corner of the gel yields up to four times as easily as its
# middle, and large strain softens it further.
LOWER = 0.2
# Allowed multiple of the upper bound: large strain stiffens, friction adds a third.
UPPER = 3.0
# Force over that of the spectral layer, which is linear: the error of default meshes is 5 to 25 %
# where contact is a few elements wide, that of linearity 10 % at large strain.
LAYER_LEAST, LAYER_MOST = 0.5, 1.8
# Depths, in thicknesses, at which a layer of small strain is a reliable reference.
LAYER_DEPTH = 0.02, 0.15


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
    def box(self) -> tuple[Array, Array] | None:
        """Least and greatest x, least and greatest y of the touched region [m]."""
        rows, columns = np.nonzero(self.deep > 0)
        if not len(rows):
            return None
        return self.x[[rows.min(), rows.max()]], self.y[[columns.min(), columns.max()]]


@lru_cache(maxsize=64)
def footprint(scene: Scene, tip: Point) -> Footprint:
    """Return the footprint with the tip at `tip` [m]."""
    body = scene.body
    depth = max(-tip[2], 1e-2 * body.thickness)
    sides = scene.indenter.bounds_below(1.5 * depth + body.thickness)[:2]
    ends = []
    for side, size, at in zip(sides, (body.size_x / 2, body.size_y / 2), tip[:2], strict=True):
        low, high = np.clip(np.array(side) + at, -size, size)
        # An indenter next to the gel leaves a strip without width at the rim.
        ends.append((low, max(high, low + 1e-9)))
    raster = _sampled(scene, tip, *ends)
    for _ in range(2):
        box = raster.box
        if box is None:
            row, column = np.unravel_index(int(np.argmax(raster.deep)), raster.deep.shape)
            box = raster.x[[row, row]], raster.y[[column, column]]
        nearer = [
            (max(low - places[1] + places[0], end[0]), min(high + places[1] - places[0], end[1]))
            for (low, high), places, end in zip(box, (raster.x, raster.y), ends, strict=True)
        ]
        closer = _sampled(scene, tip, *nearer)
        if closer.deepest < raster.deepest:
            break
        raster = closer
    return raster


def _sampled(
    scene: Scene, tip: Point, along_x: tuple[float, float], along_y: tuple[float, float]
) -> Footprint:
    x, y = np.linspace(*along_x, SAMPLES), np.linspace(*along_y, SAMPLES)
    reach = max(-tip[2], 0.0) * 1.05 + 2e-2 * scene.body.thickness
    height = scene.indenter.heights((x - tip[0])[:, None], (y - tip[1])[None], reach=reach)
    there = np.isfinite(height) & scene.body.covers(x[:, None], y)
    deep = np.where(there, scene.body.heights(x, y) - tip[2] - height, -np.inf)
    return Footprint(x, y, deep)


def half_wall(scene: Scene) -> float:
    """Return half of the indenter's narrowest wall, or its smallest radius [m]; inf without one."""
    indenter = scene.indenter
    if indenter.solid is not None:
        return max(indenter.edge_radius, indenter.solid.spacing)
    radii = [part.values[2] for part in indenter.parts if part.figure == "circle"]
    least = min([indenter.edge_radius_max, *radii])
    return float(least) if least > 0 else math.inf


def inside_by(scene: Scene, tip: Point, margin: float) -> bool:
    """Return True if the touched region stays `margin` [m] away from every rim of the gel."""
    box = footprint(scene, tip).box
    return box is None or bool(scene.body.from_side(box[0][:, None], box[1]).min() >= margin)


def least_force(scene: Scene, tip: Point) -> float:
    """Return a lower bound of the push of a frictionless press into an elastic gel [N].

    A flat disc that fits into the indenter at some depth presses less than the indenter, and the
    half-space under it is softer than a layer on a rigid base: 2 E* a d. In series with it is the
    whole gel as a column, so that a slim gel may yield as such.
    """
    raster, body = footprint(scene, tip), scene.body
    stiffness = body.modulus / (1 - body.poisson**2)
    area = body.size_x * body.size_y * (1.0 if body.footprint == "rectangle" else math.pi / 4)
    column = body.thickness / (body.modulus * area)
    steps = raster.x[1] - raster.x[0], raster.y[1] - raster.y[0]
    best = 0.0
    for fraction in (0.25, 0.5, 0.67, 0.85, 0.98) if raster.deepest > 0 else ():
        depth = fraction * raster.deepest
        within = np.pad(raster.deep >= depth, 1)
        radius = distance_transform_edt(within, sampling=steps).max() - max(steps)
        if radius > 0:
            best = max(best, depth / (1 / (2 * stiffness * radius) + column))
    return best


def most_force(scene: Scene, tip: Point) -> float:
    """Return an upper bound of the push of a frictionless press into an elastic gel [N].

    A disc around the whole contact presses more. Its force on a bonded layer is that on the
    half-space plus that of squeezing, the lesser of confined columns and of an incompressible sheet
    that flows sideways. The layer that is squeezed has the remaining thickness.
    """
    raster, body = footprint(scene, tip), scene.body
    if raster.box is None:
        return 0.0
    radius = math.hypot(*(float(high - low) for low, high in raster.box)) / 2
    left = max(body.thickness - raster.deepest, 0.05 * body.thickness)
    shear, stretch = body.shear_modulus, 2 * body.modulus / (1 - body.poisson**2)
    confined = (body.bulk_modulus + 4 / 3 * shear) * math.pi * radius**2 / left
    flowing = 1.5 * math.pi * shear * radius**4 / left**3
    half_space = stretch * radius * (body.thickness / left) ** 2
    return raster.deepest * (half_space + min(confined, flowing + stretch * radius**2 / left))


def layer_force(scene: Scene, tip: Point) -> float | None:
    """Return the push on the spectral layer at this place [N]; None where it is not reliable."""
    body = scene.body
    shallow = LAYER_DEPTH[0] <= -tip[2] / body.thickness <= LAYER_DEPTH[1]
    if body.dome_radius is not None or not shallow:
        return None
    if not inside_by(scene, tip, 0.75 * body.thickness):
        return None
    try:
        (outcome,) = simulate_many([Scene(scene.indenter, Motion((tip,), (0.0,)), body)], Layer())
    except SceneError:
        return None
    return None if isinstance(outcome, SimulationDiverged) else -float(outcome.force[-1, 2])
