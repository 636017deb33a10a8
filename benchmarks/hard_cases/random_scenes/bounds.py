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
from sim.scene import Motion, Point, Scene
from sim.tiers import simulate

Array = NDArray[np.float64]

# Number of samples along x and y; later passes cover only the region of the one before.
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
    raster = _sampled(scene, tip, whole)
    for _ in range(2):
        steps = [axis[1] - axis[0] for axis in raster.axes]
        nearer = [
            np.clip((low - step, high + step), *ends)
            for (low, high), step, ends in zip(raster.box, steps, whole, strict=True)
        ]
        closer = _sampled(scene, tip, nearer)
        if closer.deepest < raster.deepest:
            break
        raster = closer
    return raster


def _sampled(scene: Scene, tip: Point, region: list[Array]) -> Footprint:
    # An indenter next to the gel leaves a strip without width at the rim.
    x, y = (np.linspace(low, max(high, low + 1e-9), SAMPLES) for low, high in region)
    reach = max(-tip[2], 0.0) * 1.05 + 2e-2 * scene.body.thickness
    height = scene.indenter.heights((x - tip[0])[:, None], (y - tip[1])[None], reach=reach)
    there = np.isfinite(height) & scene.body.covers(x[:, None], y)
    deep = np.where(there, scene.body.heights(x, y) - tip[2] - height, -np.inf)
    return Footprint((x, y), deep)


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
    steps = [axis[1] - axis[0] for axis in raster.axes]
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
    radius = math.hypot(*(high - low for low, high in raster.box)) / 2
    left = max(body.thickness - raster.deepest, 0.05 * body.thickness)
    shear, stretch = body.shear_modulus, 2 * body.modulus / (1 - body.poisson**2)
    confined = (body.bulk_modulus + 4 / 3 * shear) * math.pi * radius**2 / left
    flowing = 1.5 * math.pi * shear * radius**4 / left**3
    half_space = stretch * radius * (body.thickness / left) ** 2
    stiffness = half_space + min(confined, flowing + stretch * radius**2 / left)
    return max(raster.deepest, 0.0) * stiffness


def layer_force(scene: Scene, tip: Point) -> float | None:
    """Return the push on the spectral layer at this place [N]; None where it is not reliable."""
    body = scene.body
    shallow = LAYER_DEPTH[0] <= -tip[2] / body.thickness <= LAYER_DEPTH[1]
    flat = body.dome_radius is None
    if not (flat and shallow and inside_by(scene, tip, 0.75 * body.thickness)):
        return None
    try:
        result = simulate(Scene(scene.indenter, Motion((tip,), (0.0,)), body), Layer())
    except (SceneError, SimulationDiverged):
        return None
    return -float(result.force[-1, 2])
