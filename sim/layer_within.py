"""A tolerance that `layer` keeps: where its own estimate may stand for a measurement, and why.

No second mesh is solved: the estimate of `sim.error_estimate` is taken at its word, and only where
it was held against forces found by other means. Those are the presses without friction of
`python -m benchmarks independent --set axisymmetric --tier layer`, and 30 more scenes without
friction by `fem` within 1.5 to 3 %: punches, boxes, bars, balls and shapes of the catalogue,
upright, leaning by up to 6 degrees, beside the middle and sliding. The estimate covered all of
them; of the 30 none took more than 0.77 of it. tests/sim/test_tolerance_by_layer.py holds some.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sim.error_estimate import LAYER_LEAST, LAYER_PER_DEPTH, pixel_of, side_distance
from sim.metrics import Tolerance, force_scale, with_unit
from sim.result import Result
from sim.scene import Scene
from sim.tiers import simulate_one

# Poisson's ratios that the estimate was held against.
POISSON = 0.3, 0.49
# Depth over thickness, the same. `layer` itself ends nowhere.
DEEPEST = 0.4
# Width of the contact over thickness, the same: of a punch 40 times as wide at a Poisson's ratio of
# 0.3 the estimate is almost used up, 9.4 of 9.7 %.
WIDEST = 10.0


def worth_a_look(scene: Scene, wanted: Tolerance) -> bool:
    """Whether `layer` may be taken unasked: it was held against such scenes, and may be so exact.

    Markers have no estimate. Neither friction, of which the estimate covers presses but was hardly
    held against shear, nor any other effect; no dome, no round body, no indenter from a file.
    """
    body = scene.body
    least = LAYER_LEAST + LAYER_PER_DEPTH * scene.motion.depth_max / body.thickness
    return (
        wanted.kind != "marker"
        and (wanted.kind != "share" or least <= wanted.value)
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
    """The scene by `layer`, its error in the unit of the tolerance, and both in words.

    The error is inf where the tier states none that could be compared with the tolerance;
    `record["error"]` has the largest one in `newton` [N] too, where there is one.

    Args:
        scene: What is simulated.
        wanted: The tolerance.
        progress: Called with the share done, 0 to 1.

    Raises:
        SceneError: What `layer` does not know.
        SimulationDiverged: No contact was found.
    """
    result = simulate_one(scene, "layer", progress=progress)
    error = result.record["error"]
    if error["status"] != "estimated":
        return result, np.inf, f"layer: error not known, {error['why']}"
    newton = float((np.array(error["force"]) * force_scale(result.force)).max(initial=0.0))
    result = replace(result, record={**result.record, "error": {**error, "newton": newton}})
    if wanted.kind == "marker":
        return result, np.inf, "layer: error of markers not known, only that of the force is"
    value = error["percent"] / 100 if wanted.kind == "share" else newton
    return result, value, f"layer: {with_unit(wanted.kind, value)}, estimated"


def not_shown(result: Result) -> str | None:
    """Why a `layer` result is not what its estimate was held against; None where it is."""
    if not result.force.any():
        return "layer: no force at all"
    width = float(result.quality.contact_width.max()) / result.scene.body.thickness
    if width > WIDEST:
        return (
            f"layer: the contact is {width:.3g} thicknesses wide, its estimate was held against "
            f"{WIDEST:g} at most"
        )
    return None


def why_trusted(result: Result) -> str:
    """What the estimate of a `layer` result rests on, in a sentence for a person."""
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
