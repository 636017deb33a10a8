"""Rim: presses at and beyond the edge of the gel, where it can escape sideways."""

from __future__ import annotations

import numpy as np

from benchmarks.hard_cases.case import Case, Solver
from benchmarks.hard_cases.cases.bodies import MM, SPHERE
from benchmarks.hard_cases.laws import (
    Law,
    at_least,
    at_most,
    conserves,
    lets_go,
    mirrored,
    push,
    rises,
    smooth,
    swapped,
    validity_laws,
)
from sim.scene import Scene, press

DEPTHS = [0.1 * MM * step for step in range(1, 16)]


def _at(solver: Solver, x: float) -> list[Law]:
    result = solver.one(Scene(SPHERE, press(DEPTHS, at=(x, 0.0))))
    return [
        *validity_laws(result, det_f=0.4),
        # The gel escapes outwards; on the gel's side of the sphere it is pushed inwards, so the
        # indenter's force on the body points inwards: negative at positive x.
        at_least("force inwards / force down", -result.force[-1, 0] / push(result)[-1], 0.02),
        at_most("force along the rim / force", abs(result.force[-1, 1]) / push(result)[-1], 1e-3),
        # Trapezoid rule over 15 steps.
        conserves(result, 0.01),
        rises("force rises with depth", push(result)),
    ]


def rim_8_mm(solver: Solver) -> list[Law]:
    """1.5 mm deep at x = 8 mm, where the contact ends near the rim (10 mm)."""
    return _at(solver, 8 * MM)


def rim_10_mm(solver: Solver) -> list[Law]:
    """1.5 mm deep with the tip right above the rim."""
    return _at(solver, 10 * MM)


def rim_11_5_mm(solver: Solver) -> list[Law]:
    """1.5 mm deep with the tip beyond the rim: the sphere's flank presses the edge."""
    return _at(solver, 11.5 * MM)


def crossing_the_rim(solver: Solver) -> list[Law]:
    """From x = 6 to 12.5 mm the force decreases smoothly as the contact crosses the rim."""
    places = [6 * MM + 0.5 * MM * step for step in range(14)]
    results = solver.many([Scene(SPHERE, press([1.0 * MM], at=(x, 0.0))) for x in places])
    force = [push(result)[-1] for result in results]
    # Elements of 1 mm make the force ripple by 2 % from node to node, which is up to four times as
    # much in a second difference. A sudden loss of contact (a third of it) would be 30 %.
    return [
        *validity_laws(*results, det_f=0.4),
        rises("force falls outwards", -np.asarray(force)),
        smooth("largest second difference / largest force", force, 0.1),
    ]


def both_rims_alike(solver: Solver) -> list[Law]:
    """The rims at +x and -x give mirror images of each displacement."""
    right, left = solver.many(
        [Scene(SPHERE, press([1.5 * MM], at=(x, 0.0))) for x in (9 * MM, -9 * MM)]
    )
    return [*validity_laws(right, left, det_f=0.4), mirrored(right, left, 1e-3)]


def corner(solver: Solver) -> list[Law]:
    """On a corner of the gel x and y are equivalent, and no force remains after lift-off."""
    motion = press([0.75 * MM, 1.5 * MM, 0.75 * MM, 0.0], at=(9.5 * MM, 9.5 * MM))
    result = solver.one(Scene(SPHERE, motion))
    return [*validity_laws(result, det_f=0.4), swapped(result, result, 1e-3), lets_go(result)]


CASES = (
    Case(rim_8_mm, seconds=4),
    Case(rim_10_mm, seconds=4),
    Case(rim_11_5_mm, seconds=4),
    Case(crossing_the_rim, seconds=8),
    Case(both_rims_alike, seconds=2),
    Case(corner, seconds=2),
)
