"""Edges and rims: edge radii far below an element; presses at and beyond the gel's edge."""

import math
from typing import Any

import numpy as np

from benchmarks.hard_cases import laws as law
from benchmarks.hard_cases.bodies import GEL, MM, PAD, ball, down, even
from benchmarks.hard_cases.laws import Laws, push
from benchmarks.hard_cases.solver import Case, case
from benchmarks.independent.linear_layer import LinearLayer, layer_punch
from sim.indenters import Indenter, named, shapes
from sim.result import Result
from sim.scene import Body, Scene

CONE = shapes.cone(math.radians(30), 0.3 * MM, 0.1 * MM)
PUNCH = shapes.flat_punch(3 * MM, 0.3 * MM)
PUNCH_DEPTH = 0.3
PLACES = (0.0, 0.125, 0.25, 0.375, 0.5)


def _one_way_or_another(says: str, indenter: Indenter, body: Body = GEL, **numerics: Any) -> Case:
    scenes = [Scene(indenter, motion, body) for motion in (down(1), even(1, 10))]

    @case(*scenes, says=says, det_f=0.1, **numerics)
    def alike(direct: Result, slow: Result) -> Laws:
        # With the edge radius below the element size, contact points slip over the edge, which
        # leaves slightly different states; true path dependence would be 10 to 30 %.
        yield law.same_end(slow, direct, 2e-3, "in 1 frame and in 10")
        yield law.deeper(slow)

    return alike


def _spread(results: tuple[Result, ...], limit: float) -> law.Law:
    force = law.ends(results)
    return law.at_most("spread of the force", max(force) / min(force) - 1, limit)


@case(Scene(CONE, even(1, 20), PAD), det_f=0.1, spacing=0.5 * MM, or_none=True)
def sharp_cone(result: Result) -> Laws:
    """A 30 degree cone (tip 0.3 mm, edge 0.1 mm) 1 mm deep pushes straight up, or is rejected."""
    return [law.straight(result, 0.01), law.conserves(result, 0.02)]


@case(Scene(CONE, down(0.5, 1), PAD), det_f=0.1)
def cone_on_a_coarse_mesh(result: Result) -> Laws:
    """The same cone on elements ten times its edge radius: valid, with a large error estimate."""
    yield law.at_least("stated error [%]", result.record["error"]["percent"], 20.0)


# On elements of 1 mm such a wall may converge to one of two states, 1 % apart in force.
# Contact is stiff: with soft contact, 10 frames are 0.2 % closer to the solution than one.
tube_wall = _one_way_or_another(
    "A tube's wall, 0.8 mm wide and rounded to 0.4 mm, 1 mm deep in 1 frame or in 10.",
    named("cylinder_sh", 0.4 * MM),
    PAD,
    spacing=0.5 * MM,
    penalty=1000.0,
)


@case(
    *(Scene(named("cylinder_sh"), down(0.6, at=(x, x / 2)), PAD) for x in PLACES[:3]),
    det_f=0.1,
    spacing=0.5 * MM,
)
def tube_off_the_grid(*results: Result) -> Laws:
    """The tube's force hardly depends on the position of its wall between the nodes."""
    # 3 contact points span the wall, 1 to 2 without its rounded edges: their count varies around
    # the ring. On elements of 1 mm, wider than the wall, the spread is 20 %.
    yield _spread(results, 0.10)


prism_edge = _one_way_or_another(
    "A prism with edges of 0.3 mm on elements of 1 mm, 1 mm deep in 1 frame or in 10.",
    named("prism"),
)
prism_without_edge_radius = _one_way_or_another(
    "Perfectly sharp edges: 1 mm deep in 1 frame or in 10, and nothing inverts.",
    named("prism", 0.0),
)


@case(Scene(PUNCH, down(PUNCH_DEPTH)))
def flat_punch_between_bounds(result: Result) -> Laws:
    """A flat punch with a rounded edge lies between the exact punches with and without its rim."""
    layer = LinearLayer(4 * MM, 0.145e6, 0.45)
    narrow, wide = (layer_punch(PUNCH_DEPTH * MM, r * MM, layer).force for r in (2.7, 3.0))
    # 3 % beyond the bounds for the effect of large strain at a depth of 7.5 % of the thickness.
    yield law.at_least("force / exact, radius 2.7 mm", push(result)[-1] / narrow, 0.97)
    yield law.at_most("force / exact, radius 3.0 mm", push(result)[-1] / wide, 1.03)


@case(*(Scene(PUNCH, down(PUNCH_DEPTH, at=(x, 0.0))) for x in PLACES))
def flat_punch_off_the_grid(*results: Result) -> Laws:
    """A flat punch's force does not depend on its position between the nodes."""
    # 12 contact points along the rim's diameter: one more or less of them is 4 %.
    yield _spread(results, 0.08)


@case(Scene(PUNCH, even(0.6, 30)), det_f=0.3, spacing=0.5 * MM)
def flat_punch_is_smooth(result: Result) -> Laws:
    """A flat punch's force against depth has no jump when nodes slip over its edge."""
    # A straight line has no second difference; contact points leave over the edge ring by ring.
    yield law.smooth(push(result)[1:], 0.01)


def _at_the_rim(place: str, x: float) -> Case:
    @case(ball(even(1.5, 15, at=(x, 0))), says=f"1.5 mm deep {place}.", det_f=0.4)
    def pressed(result: Result) -> Laws:
        inwards, along, push = result.force[-1] * [-1, 1, -1]
        # The gel escapes outwards; on the gel's side of the sphere it is pushed inwards, so the
        # indenter's force on the body points inwards: negative at positive x.
        yield law.at_least("force inwards / force down", inwards / push, 0.02)
        yield law.at_most("force along the rim / force", abs(along / push), 1e-3)
        # Trapezoid rule over 15 steps.
        yield law.conserves(result, 0.01)
        yield law.deeper(result)

    return pressed


rim_8_mm = _at_the_rim("at x = 8 mm, where the contact ends near the rim (10 mm)", 8)
rim_10_mm = _at_the_rim("with the tip right above the rim", 10)
rim_11_5_mm = _at_the_rim("with the tip beyond the rim: the sphere's flank presses the edge", 11.5)


@case(*(ball(down(1, at=(6 + step / 2, 0))) for step in range(14)), det_f=0.4)
def crossing_the_rim(*results: Result) -> Laws:
    """From x = 6 to 12.5 mm the force decreases smoothly as the contact crosses the rim."""
    force = np.array(law.ends(results))
    # Elements of 1 mm make the force ripple by 2 % from node to node, which is up to four times as
    # much in a second difference. A sudden loss of contact (a third of it) would be 30 %.
    yield law.rises("force falls outwards", -force)
    yield law.smooth(force, 0.1)


@case(*(ball(down(1.5, at=(x, 0))) for x in (9, -9)), det_f=0.4)
def both_rims_alike(right: Result, left: Result) -> Laws:
    """The rims at +x and -x give mirror images of each displacement."""
    yield law.mirrored(right, left, 1e-3)


@case(ball(down(0.75, 1.5, 0.75, 0.0, at=(9.5, 9.5))), det_f=0.4)
def corner(result: Result) -> Laws:
    """On a corner of the gel x and y are equivalent, and no force remains after lift-off."""
    yield law.swapped(result, result, 1e-3)
