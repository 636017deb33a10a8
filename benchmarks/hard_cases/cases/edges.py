"""Edges and rims: edge radii far below an element; presses at and beyond the gel's edge."""

from __future__ import annotations

import math

import numpy as np

from benchmarks.hard_cases.cases.bodies import GEL, MM, PAD, SPHERE
from benchmarks.hard_cases.laws import (
    Law,
    at_least,
    at_most,
    conserves,
    evidence,
    lets_go,
    mirrored,
    push,
    rises,
    same_end,
    smooth,
    swapped,
    validity_laws,
)
from benchmarks.hard_cases.solver import Solver
from benchmarks.independent.formulas import LinearLayer, layer_punch
from sim.errors import SimulationDiverged
from sim.indenters import Indenter, named, shapes
from sim.scene import Body, Scene, press

CONE = shapes.cone(math.radians(30), 0.3 * MM, 0.1 * MM)
PUNCH = shapes.flat_punch(3 * MM, 0.3 * MM)
PUNCH_DEPTH = 0.3 * MM
MANY = [0.1 * MM * step for step in range(1, 11)]
# Two ways to press an edge in: with the edge radius below the element size, contact points slip
# over the edge, which leaves slightly different states; true path dependence would be 10 to 30 %.
PATH = 2e-3


def _one_way_or_another(
    solver: Solver, indenter: Indenter, body: Body = GEL, **numerics: object
) -> list[Law]:
    direct = solver.one(Scene(indenter, press([1.0 * MM]), body), **numerics)
    slow = solver.one(Scene(indenter, press(MANY), body), **numerics)
    return [
        *validity_laws(direct, slow),
        same_end("in 1 frame and in 10", slow, direct, PATH),
        rises("force rises with depth", push(slow)),
    ]


def sharp_cone(solver: Solver) -> list[Law]:
    """A 30 degree cone (tip 0.3 mm, edge 0.1 mm) 1 mm deep pushes straight up, or is rejected."""
    motion = press([0.05 * MM * step for step in range(1, 21)])
    try:
        result = solver.one(Scene(CONE, motion, PAD), spacing=0.5 * MM)
    except SimulationDiverged as diverged:
        return evidence(diverged)
    aside = np.abs(result.force[:, :2]).max() / push(result).max()
    return [
        *validity_laws(result),
        at_most("force aside / force", aside, 0.01),
        conserves(result, 0.02),
    ]


def cone_on_a_coarse_mesh(solver: Solver) -> list[Law]:
    """The same cone on elements ten times its edge radius: valid, with a large error estimate."""
    result = solver.one(Scene(CONE, press([0.5 * MM, 1 * MM]), PAD))
    message = result.record["error"]["percent"]
    return [*validity_laws(result), at_least("stated error [%]", message, 20.0)]


def tube_wall(solver: Solver) -> list[Law]:
    """A tube's wall, 0.8 mm wide and rounded to 0.4 mm, 1 mm deep in 1 frame or in 10."""
    # On elements of 1 mm such a wall may converge to one of two states, 1 % apart in force.
    # Contact is stiff: with soft contact, 10 frames are 0.2 % closer to the solution than one.
    wall = named("cylinder_sh", 0.4 * MM)
    return _one_way_or_another(solver, wall, PAD, spacing=0.5 * MM, penalty=1000.0)


def tube_off_the_grid(solver: Solver) -> list[Law]:
    """The tube's force hardly depends on the position of its wall between the nodes."""
    places = (0.0, 0.125 * MM, 0.25 * MM)
    scenes = [Scene(named("cylinder_sh"), press([0.6 * MM], at=(x, x / 2)), PAD) for x in places]
    results = solver.many(scenes, spacing=0.5 * MM)
    force = [push(result)[-1] for result in results]
    # 3 contact points span the wall, 1 to 2 without its rounded edges: their count varies around
    # the ring. On elements of 1 mm, wider than the wall, the spread is 20 %.
    return [
        *validity_laws(*results),
        at_most("spread of the force", max(force) / min(force) - 1, 0.10),
    ]


def prism_edge(solver: Solver) -> list[Law]:
    """A prism with edges of 0.3 mm on elements of 1 mm, 1 mm deep in 1 frame or in 10."""
    return _one_way_or_another(solver, named("prism"))


def prism_without_edge_radius(solver: Solver) -> list[Law]:
    """Perfectly sharp edges: 1 mm deep in 1 frame or in 10, and nothing inverts."""
    return _one_way_or_another(solver, named("prism", 0.0))


def flat_punch_between_bounds(solver: Solver) -> list[Law]:
    """A flat punch with a rounded edge lies between the exact punches with and without its rim."""
    result = solver.one(Scene(PUNCH, press([PUNCH_DEPTH])))
    narrow, wide = (
        layer_punch(PUNCH_DEPTH, radius, LinearLayer(4 * MM, 0.145e6, 0.45)).force
        for radius in (2.7 * MM, 3.0 * MM)
    )
    # 3 % beyond the bounds for the effect of large strain at a depth of 7.5 % of the thickness.
    return [
        *validity_laws(result, det_f=0.5),
        at_least("force / exact, radius 2.7 mm", push(result)[-1] / narrow, 0.97),
        at_most("force / exact, radius 3.0 mm", push(result)[-1] / wide, 1.03),
    ]


def flat_punch_off_the_grid(solver: Solver) -> list[Law]:
    """A flat punch's force does not depend on its position between the nodes."""
    places = (0.0, 0.125 * MM, 0.25 * MM, 0.375 * MM, 0.5 * MM)
    scenes = [Scene(PUNCH, press([PUNCH_DEPTH], at=(place, 0.0))) for place in places]
    results = solver.many(scenes)
    force = [push(result)[-1] for result in results]
    # 12 contact points along the rim's diameter: one more or less of them is 4 %.
    return [
        *validity_laws(*results, det_f=0.5),
        at_most("spread of the force", (max(force) - min(force)) / min(force), 0.08),
    ]


def flat_punch_is_smooth(solver: Solver) -> list[Law]:
    """A flat punch's force against depth has no jump when nodes slip over its edge."""
    depths = [0.02 * MM * step for step in range(1, 31)]
    result = solver.one(Scene(PUNCH, press(depths)), spacing=0.5 * MM)
    # A straight line has no second difference; contact points leave over the edge ring by ring.
    return [
        *validity_laws(result, det_f=0.3),
        smooth("largest second difference / largest force", push(result)[1:], 0.01),
    ]


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
