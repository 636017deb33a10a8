"""Tolerances met by `layer`: conditions under which its estimate replaces a measured error.

No second mesh is solved. The estimate of `sim.error_estimate` is trusted only for scenes like those
on which it was checked against independent forces. These are the frictionless presses of
`python -m benchmarks independent --set axisymmetric --tier layer`, and 30 more frictionless scenes
by `fem` within 1.5 to 3 %: punches, boxes, bars, balls and shapes of the catalogue, upright, tilted
by up to 6 degrees, off-centre and sliding. The estimate covered all of them; none of the 30 errors
was more than 0.77 of it. tests/sim/test_tolerance_by_layer.py has some of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sim.error_estimate import LAYER_LEAST, LAYER_PER_DEPTH, pixel_of, side_distance
from sim.layer.numerics import Layer
from sim.metrics import Tolerance, force_scale, with_unit
from sim.result import Result
from sim.scene import Scene
from sim.tiers import simulate_one

# Range of Poisson's ratio in which the estimate was checked.
POISSON = 0.3, 0.49
# Largest depth over thickness at which it was checked. `layer` itself has no such limit.
DEEPEST = 0.4
# Largest width of the contact over thickness at which it was checked: for a punch 40 times as wide
# at a Poisson's ratio of 0.3 the estimate is almost used up, 9.4 of 9.7 %.
WIDEST = 10.0


def worth_a_look(scene: Scene, wanted: Tolerance) -> bool:
    """True if `layer` was checked on such scenes, and may be accurate enough.

    Markers have no estimate. Scenes with friction are excluded, as the estimate covers presses but
    was hardly checked for shear. So are all other effects, domes, round bodies and indenters from a
    file.
    """
    body = scene.body
    least = LAYER_LEAST + LAYER_PER_DEPTH * scene.motion.depth_max / body.thickness
    return (
        wanted.kind != "marker"
        and (wanted.kind != "fraction" or least <= wanted.value)
        and not scene.effects.key
        and body.dome_radius is None
        and body.footprint == "rectangle"
        and scene.indenter.solid is None
        and POISSON[0] <= body.poisson <= POISSON[1]
        and 0 < scene.motion.depth_max <= (DEEPEST + 1e-9) * body.thickness
    )


def solved_by_layer(
    scene: Scene, wanted: Tolerance, *, progress: Callable[[float], None] | None = None
) -> tuple[Result, float, str]:
    """Solve the scene by `layer`; return its error in the tolerance's unit, and both in words.

    The error is inf if the tier states none that is comparable with the tolerance;
    `record["error"]` also has the largest one as `newton` [N], if there is one.

    Args:
        scene: Scene to simulate.
        wanted: Tolerance.
        progress: Called with the fraction done, 0 to 1.

    Raises:
        SceneError: The scene is not supported by `layer`.
        SimulationDiverged: The contact did not converge.
    """
    result = simulate_one(scene, Layer(), progress=progress)
    error = result.record["error"]
    if error["status"] != "estimated":
        return result, np.inf, f"layer: error not known, {error['why']}"
    newton = float((np.array(error["force"]) * force_scale(result.force)).max(initial=0.0))
    result = replace(result, record={**result.record, "error": {**error, "newton": newton}})
    if wanted.kind == "marker":
        return result, np.inf, "layer: error of markers not known, only that of the force"
    value = error["percent"] / 100 if wanted.kind == "fraction" else newton
    return result, value, f"layer: {with_unit(wanted.kind, value)}, estimated"


def not_shown(result: Result) -> str | None:
    """Return why a `layer` result is outside the checked range of its estimate; None if inside."""
    if not result.force.any():
        return "layer: no force at all"
    width = float(result.quality.contact_width.max()) / result.scene.body.thickness
    if width > WIDEST:
        return (
            f"layer: the contact is {width:.3g} thicknesses wide, its estimate was checked up to "
            f"{WIDEST:g}"
        )
    return None


def why_trusted(result: Result) -> str:
    """Return the basis of the estimate of a `layer` result, in a sentence for the user."""
    thickness = result.scene.body.thickness
    width = float(result.quality.contact_width.max())
    side = side_distance(result)
    far = "no contact" if side is None else f"{side / thickness:.2g} thicknesses from any side"
    return (
        f"'layer' is linear and has no sides; here the depth is up to "
        f"{result.scene.motion.depth_max / thickness:.2g} of the thickness, the contact up to "
        f"{width / thickness:.2g} thicknesses or {width / pixel_of(result):.0f} pixels wide, and "
        f"{far}. Its error is estimated from these, not measured, and is that of the force alone"
    )
