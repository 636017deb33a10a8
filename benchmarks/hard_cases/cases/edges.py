"""Edges and rims: edge radii far below an element; presses at and beyond the gel's edge."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from benchmarks.hard_cases import laws as law
from benchmarks.hard_cases.cases.bodies import GEL, MM, PAD, ball, even
from benchmarks.hard_cases.laws import Law, push
from benchmarks.hard_cases.solver import Case, Solver, case
from benchmarks.independent.linear_layer import LinearLayer, layer_punch
from sim.errors import SimulationDiverged
from sim.indenters import Indenter, named, shapes
from sim.result import Result
from sim.scene import Body, Scene, press

CONE = shapes.cone(math.radians(30), 0.3 * MM, 0.1 * MM)
PUNCH = shapes.flat_punch(3 * MM, 0.3 * MM)
PUNCH_DEPTH = 0.3 * MM
PLACES = (0.0, 0.125 * MM, 0.25 * MM, 0.375 * MM, 0.5 * MM)
DEEPER = "force rises with depth"


def _one_way_or_another(says: str, indenter: Indenter, body: Body = GEL, **numerics: Any) -> Case:
    return case(
        says,
        [Scene(indenter, press(depths), body) for depths in ([1 * MM], even(1 * MM, 10))],
        lambda direct, slow: [
            # With the edge radius below the element size, contact points slip over the edge, which
            # leaves slightly different states; true path dependence would be 10 to 30 %.
            law.same_end("in 1 frame and in 10", slow, direct, 2e-3),
            law.rises(DEEPER, push(slow)),
        ],
        det_f=0.1,
        **numerics,
    )


def _sharp_cone(solver: Solver) -> list[Law]:
    """A 30 degree cone (tip 0.3 mm, edge 0.1 mm) 1 mm deep pushes straight up, or is rejected."""
    try:
        result = solver.one(Scene(CONE, press(even(1 * MM, 20)), PAD), spacing=0.5 * MM)
    except SimulationDiverged as diverged:
        return law.evidence(diverged)
    return [*law.validity_laws(result), law.straight(result, 0.01), law.conserves(result, 0.02)]


def _between_bounds(result: Result) -> list[Law]:
    narrow, wide = (
        layer_punch(PUNCH_DEPTH, radius, LinearLayer(4 * MM, 0.145e6, 0.45)).force
        for radius in (2.7 * MM, 3.0 * MM)
    )
    # 3 % beyond the bounds for the effect of large strain at a depth of 7.5 % of the thickness.
    return [
        law.at_least("force / exact, radius 2.7 mm", push(result)[-1] / narrow, 0.97),
        law.at_most("force / exact, radius 3.0 mm", push(result)[-1] / wide, 1.03),
    ]


def _spread(limit: float, *results: Result) -> list[Law]:
    force = [push(result)[-1] for result in results]
    return [law.at_most("spread of the force", max(force) / min(force) - 1, limit)]


def _at_the_rim(says: str, x: float) -> Case:
    return case(
        f"1.5 mm deep {says}.",
        [ball(press(even(1.5 * MM, 15), at=(x, 0.0)))],
        lambda result: [
            # The gel escapes outwards; on the gel's side of the sphere it is pushed inwards, so the
            # indenter's force on the body points inwards: negative at positive x.
            law.at_least("force inwards / force down", -_side(result, 0), 0.02),
            law.at_most("force along the rim / force", abs(_side(result, 1)), 1e-3),
            # Trapezoid rule over 15 steps.
            law.conserves(result, 0.01),
            law.rises(DEEPER, push(result)),
        ],
        det_f=0.4,
    )


def _side(result: Result, axis: int) -> float:
    """Return the force along an axis over the push, in the last frame."""
    return float(result.force[-1, axis] / push(result)[-1])


def _falls_smoothly(*results: Result) -> list[Law]:
    force = [push(result)[-1] for result in results]
    # Elements of 1 mm make the force ripple by 2 % from node to node, which is up to four times as
    # much in a second difference. A sudden loss of contact (a third of it) would be 30 %.
    return [law.rises("force falls outwards", -np.asarray(force)), law.smooth(law.KINK, force, 0.1)]


CASES: dict[str, Case] = {
    "sharp-cone": _sharp_cone,
    "cone-on-a-coarse-mesh": case(
        "The same cone on elements ten times its edge radius: valid, with a large error estimate.",
        [Scene(CONE, press([0.5 * MM, 1 * MM]), PAD)],
        lambda it: [law.at_least("stated error [%]", it.record["error"]["percent"], 20.0)],
        det_f=0.1,
    ),
    # On elements of 1 mm such a wall may converge to one of two states, 1 % apart in force.
    # Contact is stiff: with soft contact, 10 frames are 0.2 % closer to the solution than one.
    "tube-wall": _one_way_or_another(
        "A tube's wall, 0.8 mm wide and rounded to 0.4 mm, 1 mm deep in 1 frame or in 10.",
        named("cylinder_sh", 0.4 * MM),
        PAD,
        spacing=0.5 * MM,
        penalty=1000.0,
    ),
    "tube-off-the-grid": case(
        "The tube's force hardly depends on the position of its wall between the nodes.",
        [Scene(named("cylinder_sh"), press([0.6 * MM], at=(x, x / 2)), PAD) for x in PLACES[:3]],
        # 3 contact points span the wall, 1 to 2 without its rounded edges: their count varies
        # around the ring. On elements of 1 mm, wider than the wall, the spread is 20 %.
        lambda *results: _spread(0.10, *results),
        det_f=0.1,
        spacing=0.5 * MM,
    ),
    "prism-edge": _one_way_or_another(
        "A prism with edges of 0.3 mm on elements of 1 mm, 1 mm deep in 1 frame or in 10.",
        named("prism"),
    ),
    "prism-without-edge-radius": _one_way_or_another(
        "Perfectly sharp edges: 1 mm deep in 1 frame or in 10, and nothing inverts.",
        named("prism", 0.0),
    ),
    "flat-punch-between-bounds": case(
        "A flat punch with a rounded edge lies between the exact punches with and without its rim.",
        [Scene(PUNCH, press([PUNCH_DEPTH]))],
        _between_bounds,
    ),
    "flat-punch-off-the-grid": case(
        "A flat punch's force does not depend on its position between the nodes.",
        [Scene(PUNCH, press([PUNCH_DEPTH], at=(place, 0.0))) for place in PLACES],
        # 12 contact points along the rim's diameter: one more or less of them is 4 %.
        lambda *results: _spread(0.08, *results),
    ),
    "flat-punch-is-smooth": case(
        "A flat punch's force against depth has no jump when nodes slip over its edge.",
        [Scene(PUNCH, press(even(0.6 * MM, 30)))],
        # A straight line has no second difference; contact points leave over the edge ring by ring.
        lambda result: [law.smooth(law.KINK, push(result)[1:], 0.01)],
        det_f=0.3,
        spacing=0.5 * MM,
    ),
    "rim-8-mm": _at_the_rim("at x = 8 mm, where the contact ends near the rim (10 mm)", 8 * MM),
    "rim-10-mm": _at_the_rim("with the tip right above the rim", 10 * MM),
    "rim-11-5-mm": _at_the_rim(
        "with the tip beyond the rim: the sphere's flank presses the edge", 11.5 * MM
    ),
    "crossing-the-rim": case(
        "From x = 6 to 12.5 mm the force decreases smoothly as the contact crosses the rim.",
        [ball(press([1.0 * MM], at=((6 + step / 2) * MM, 0.0))) for step in range(14)],
        _falls_smoothly,
        det_f=0.4,
    ),
    "both-rims-alike": case(
        "The rims at +x and -x give mirror images of each displacement.",
        [ball(press([1.5 * MM], at=(x, 0.0))) for x in (9 * MM, -9 * MM)],
        lambda right, left: [law.mirrored(right, left, 1e-3)],
        det_f=0.4,
    ),
    "corner": case(
        "On a corner of the gel x and y are equivalent, and no force remains after lift-off.",
        [ball(press([0.75 * MM, 1.5 * MM, 0.75 * MM, 0.0], at=(9.5 * MM, 9.5 * MM)))],
        lambda result: [law.swapped(result, result, 1e-3), law.lets_go(result)],
        det_f=0.4,
    ),
}
