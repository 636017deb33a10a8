"""Bounds of a force from mechanics: values outside are wrong by far, on any mesh."""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import distance_transform_edt

from benchmarks.hard_cases.random_scenes.footprint import Footprint, footprint, inside_by
from sim.errors import SceneError, SimulationDiverged
from sim.layer import Layer
from sim.result import Result
from sim.scene import Motion, Scene
from sim.tiers import simulate_many

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


def least_force(scene: Scene, tip: tuple[float, float, float]) -> float:
    """Return a lower bound of the push of a frictionless press into an elastic gel [N].

    A flat disc that fits into the indenter at some depth presses less than the indenter, and the
    half-space under it is softer than a layer on a rigid base: 2 E* a d. In series with it is the
    whole gel as a column, so that a slim gel may yield as such.
    """
    found = footprint(scene, tip)
    body = scene.body
    if found.deepest <= 0:
        return 0.0
    stiffness = body.modulus / (1 - body.poisson**2)
    area = body.size_x * body.size_y * (1.0 if body.footprint == "rectangle" else math.pi / 4)
    column = body.thickness / (body.modulus * area)
    best = 0.0
    for fraction in (0.25, 0.5, 0.67, 0.85, 0.98):
        depth = fraction * found.deepest
        radius = _inscribed(found, depth)
        if radius > 0:
            best = max(best, depth / (1 / (2 * stiffness * radius) + column))
    return best


def most_force(scene: Scene, tip: tuple[float, float, float]) -> float:
    """Return an upper bound of the push of a frictionless press into an elastic gel [N].

    A disc around the whole contact presses more. Its force on a bonded layer is that on the
    half-space plus that of squeezing, the lesser of confined columns and of an incompressible sheet
    that flows sideways. The layer that is squeezed has the remaining thickness.
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
    """Return the push on the spectral layer at this place [N]; None where it is not reliable."""
    body = scene.body
    depth = -tip[2] / body.thickness
    if body.dome_radius is not None or not LAYER_DEPTH[0] <= depth <= LAYER_DEPTH[1]:
        return None
    if not inside_by(scene, tip, 0.75 * body.thickness):
        return None
    motion = Motion((tip,), (0.0,))
    try:
        (outcome,) = simulate_many([Scene(scene.indenter, motion, body)], Layer())
    except SceneError:
        return None
    if isinstance(outcome, SimulationDiverged):
        return None
    return -float(outcome.force[-1, 2])


def _inscribed(found: Footprint, depth: float) -> float:
    """Return the radius [m] of the largest disc on the gel that is at least `depth` [m] deep."""
    within = np.pad(found.deep >= depth, 1)
    steps = found.x[1] - found.x[0], found.y[1] - found.y[0]
    radius: float = distance_transform_edt(within, sampling=steps).max()
    return float(max(radius - max(steps), 0.0))


def reached(result: Result) -> list[tuple[float, float, float]]:
    """Return the position of the tip in each frame."""
    return [(float(x), float(y), float(z)) for x, y, z in result.scene.motion.tip]
