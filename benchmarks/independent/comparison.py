"""Presses of this folder as scenes of `sim`, and their forces beside those of the other methods."""

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.independent.presses import MM, MODULUS, Press, Shape
from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.indenters import Indenter, bar, box, flat_punch, rounded_cone, sphere, torus, tube
from sim.indenters.outline import Part
from sim.layer import Layer
from sim.planning import plan
from sim.scene import Body, Effects, Friction, Scene, through
from sim.tiers import simulate

UPRIGHT: dict[Shape, Callable[..., Indenter]] = {
    "sphere": sphere,
    "punch": flat_punch,
    "torus": torus,
    "tube": tube,
    "bar": bar,
    "box": box,
}


def scene_of(press: Press) -> Scene:
    """Return a press as a scene of `sim`, whose first frame is at the surface."""
    dome = press.dome * MM if press.dome else None
    x, y, thickness = (length * MM for length in press.size)
    body = Body(x, y, thickness, MODULUS, press.poisson, dome)
    effects = Effects(friction=Friction(press.friction)) if press.friction else Effects()
    tips = [(x * MM, y * MM, -depth * MM) for x, y, depth in press.path]
    motion = through([(*tips[0][:2], 0.0), *tips], speed=10e-3)
    return Scene(_indenter(press), motion, body, effects)


def _indenter(press: Press) -> Indenter:
    first, *others = (measure * MM for measure in press.measures)
    if press.shape == "spheres":
        outline = (0.0, first, first)
        each = [Part("turned", "circle", outline, "union", axis=(x, 0.0)) for x in others or (0.0,)]
        return Indenter("spheres", tuple(each))
    if press.shape == "cone":
        return rounded_cone(math.radians(press.measures[0]), others[0])
    indenter = UPRIGHT[press.shape](first, *others)
    return indenter.tilted(*map(math.radians, press.tilt)) if any(press.tilt) else indenter


def compared(tier: Fem | Layer | str, device: str, press: Press) -> list[dict[str, Any]]:
    """Solve a press by a tier or to a tolerance, and return a row of JSON for each force.

    `truth_n` is the size of the other method's force, of axisymmetric presses that along the axis,
    and `truth_percent` its uncertainty; `force_n` is that of `sim`. `error_percent` is the size of
    their difference over `truth_n`, signed for axisymmetric presses; `stated_percent` the error
    that the result states of all its forces, or None. `seconds` are those of the whole press. A
    press that was not solved has the `reason`, and None for its forces and errors.
    """
    began = time.perf_counter()
    scene, reason, stated, forces = scene_of(press), "", None, None
    try:
        if isinstance(tier, str):
            result = plan(scene, tier, device=device).run()
        else:
            result = simulate(scene, tier, device=device)
        forces, stated = result.force[1:], result.record["error"].get("percent")
    except (SceneError, SimulationDiverged) as error:
        reason = str(error)
    seconds = time.perf_counter() - began
    rows = []
    known = [2] if press.axisymmetric else [0, 1, 2]
    for frame, (truth, percent) in enumerate(
        zip(np.array(press.forces_n)[:, known], press.uncertainty_percent, strict=True)
    ):
        right = math.hypot(*truth)
        size = off = None
        if forces is not None:
            size = math.hypot(*forces[frame, known])
            apart = math.hypot(*(forces[frame, known] - truth))
            off = 100 * (size / right - 1 if press.axisymmetric else apart / right)
        rows.append(
            {
                "case": press.name,
                "kind": press.shape,
                "depth_mm": press.path[frame][2],
                "truth_n": right,
                "truth_percent": percent,
                "force_n": size,
                "error_percent": off,
                "stated_percent": None if stated is None else float(stated),
                "seconds": seconds,
                "reason": reason,
            }
        )
    return rows
