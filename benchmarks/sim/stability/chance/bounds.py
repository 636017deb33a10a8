"""Bounds of a force from mechanics: what is less or more is wrong by far, whatever the mesh."""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import distance_transform_edt

from benchmarks.sim.stability.chance.footprint import Footprint, footprint, inside_by
from sim.errors import SceneError, SimulationDiverged
from sim.result import Result
from sim.scene import Body, Motion, Scene
from sim.tiers import simulate_many

# Share of the lower bound that must be there: a corner of the gel yields as much as four times as
# easily as its middle, and large strain softens it further.
LOWER = 0.2
# Multiple of the upper bound that may be there: large strain stiffens, friction adds a third.
UPPER = 3.0
# Force over that of the spectral layer, which is linear: default meshes are off by 5 to 25 % where
# contact is a few elements wide, large strain by 10 %.
LAYER_LEAST, LAYER_MOST = 0.5, 1.8
# Depths, in thicknesses, at which a layer of small strain is a fair judge.
LAYER_DEPTH = 0.02, 0.15


def least_force(scene: Scene, tip: tuple[float, float, float]) -> float:
    """A lower bound of the push of a frictionless press into an elastic gel [N].

    A flat disc that fits into the indenter at some depth presses less than the indenter, and the
    half-space under it is softer than a layer on a rigid base: 2 E* a d. In series with it, the
    whole gel as a column, so that a slim one may yield as such.
    """
    found = footprint(scene, tip)
    body = scene.body
    if found.deepest <= 0:
        return 0.0
    stiffness = body.modulus / (1 - body.poisson**2)
    area = body.size_x * body.size_y * (1.0 if body.footprint == "rectangle" else math.pi / 4)
    column = body.thickness / (body.modulus * area)
    best = 0.0
    for share in (0.25, 0.5, 0.67, 0.85, 0.98):
        depth = share * found.deepest
        radius = _inscribed(found, depth)
        if radius > 0:
            best = max(best, depth / (1 / (2 * stiffness * radius) + column))
    return best


def most_force(scene: Scene, tip: tuple[float, float, float]) -> float:
    """An upper bound of the push of a frictionless press into an elastic gel [N].

    A disc around all that is touched presses more. Under a bonded layer its force is that of the
    half-space and that of squeezing: the lesser of confined columns and of an incompressible sheet
    that flows aside. What is left of the thickness is what is squeezed.
    """
    found = footprint(scene, tip)
    box, body = found.box, scene.body
    if box is None:
        return 0.0
    radius = math.hypot(box[1] - box[0], box[3] - box[2]) / 2
    depth = found.deepest
    left = max(body.thickness - depth, 0.05 * body.thickness)
    shear, stretch = body.shear_modulus, 2 * body.modulus / (1 - body.poisson**2)
    confined = (body.bulk_modulus + 4 / 3 * shear) * math.pi * radius**2 / left
    flowing = 1.5 * math.pi * shear * radius**4 / left**3
    half_space = stretch * radius * (body.thickness / left) ** 2
    return depth * (half_space + min(confined, flowing + stretch * radius**2 / left))


def layer_force(scene: Scene, tip: tuple[float, float, float]) -> float | None:
    """The push that the spectral layer finds at this place [N]; None where it is no judge."""
    body = scene.body
    depth = -tip[2] / body.thickness
    if body.dome_radius is not None or not LAYER_DEPTH[0] <= depth <= LAYER_DEPTH[1]:
        return None
    if not inside_by(scene, tip, 0.75 * body.thickness):
        return None
    still = Body(body.size_x, body.size_y, body.thickness, body.modulus, body.poisson)
    motion = Motion((tip,), (0.0,))
    try:
        (outcome,) = simulate_many([Scene(scene.indenter, motion, still)], "layer")
    except SceneError:
        return None
    if isinstance(outcome, SimulationDiverged):
        return None
    return -float(outcome.force[-1, 2])


def _inscribed(found: Footprint, depth: float) -> float:
    """Radius [m] of the largest disc on the gel that is `depth` [m] deep all over."""
    within = np.pad(found.deep >= depth, 1)
    steps = found.x[1] - found.x[0], found.y[1] - found.y[0]
    radius: float = distance_transform_edt(within, sampling=steps).max()
    return float(max(radius - max(steps), 0.0))


def reached(result: Result) -> list[tuple[float, float, float]]:
    """Where the tip is in each frame."""
    return [(float(x), float(y), float(z)) for x, y, z in result.scene.motion.tip]
