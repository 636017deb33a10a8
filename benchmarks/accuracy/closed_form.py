"""Common closed-form solutions, which treat the gel as a half-space and take no time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.independent.formulas import (
    cone,
    flat_punch,
    hertz,
    hertz_contact_radius,
    lee_radok_sphere,
    mindlin_force,
)
from sim.scene import Scene

Array = NDArray[np.float64]


def closed_form(case: str, scene: Scene) -> Array | None:
    """Return the force of the indenter on the body (F, 3) [N], or None without a common formula.

    Hertz, Sneddon's punch and (sharp) cone; Lee and Radok; Cattaneo and Mindlin during shear,
    with Masing's rule on the return.
    """
    body = scene.body
    tip = np.array(scene.motion.tip)
    depth = np.maximum(-tip[:, 2], 0.0)
    material = (body.modulus, body.poisson)
    part = scene.indenter.parts[0]
    if case == "sphere":
        normal = [hertz(float(one), part.values[2], *material) for one in depth]
    elif case == "punch":
        normal = [flat_punch(float(one), part.values[2], *material) for one in depth]
    elif case == "cone":
        half_angle = float(np.arccos(part.values[0]))
        normal = [cone(float(one), half_angle, *material) for one in depth]
    elif case == "loop":
        normal = [hertz(float(one), part.values[2], *material) for one in depth]
    elif case == "hold":
        viscosity = scene.effects.viscosity
        if viscosity is None:
            return None
        normal = list(
            lee_radok_sphere(
                scene.motion.time,
                depth,
                part.values[2],
                *material,
                viscosity.ratios,
                viscosity.times,
            )
        )
    else:
        return None
    force = np.zeros((len(tip), 3))
    force[:, 2] = -np.array(normal)
    if case == "loop" and scene.effects.friction is not None:
        force[:, 0] = _shear(scene, part.values[2], np.array(normal))
    return force


def _shear(scene: Scene, radius: float, normal: Array) -> Array:
    """Return the shear force (F,) of a sphere that is sheared and returned [N], no ploughing."""
    friction, body = scene.effects.friction, scene.body
    coefficient = 0.0 if friction is None else friction.coefficient
    tip = np.array(scene.motion.tip)
    shear = np.zeros(len(tip))
    for frame in range(1, len(tip)):
        limit = coefficient * float(normal[frame])
        moved = float(tip[frame, 0] - tip[frame - 1, 0])
        before = shear[frame - 1]
        change = 0.0
        if moved and limit:
            contact = hertz_contact_radius(-float(tip[frame, 2]), radius)
            # Masing's rule for a reversal: twice the displacement for twice the force.
            fraction = 0.5 if before * moved < 0 else 1.0
            change = (
                mindlin_force(
                    moved * fraction,
                    float(normal[frame]),
                    coefficient,
                    contact,
                    body.modulus,
                    body.poisson,
                )
                / fraction
            )
        shear[frame] = np.clip(before + change, -limit, limit)
    return shear
