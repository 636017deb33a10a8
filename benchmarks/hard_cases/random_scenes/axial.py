"""Presses along the axis of a disc, by the axisymmetric solver of `benchmarks.independent`."""

import math
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from benchmarks.hard_cases.laws import Array
from benchmarks.independent import profile
from benchmarks.independent.axisymmetric import Answer, AxisymmetricPress, Layer, NotSolved
from benchmarks.independent.mesh import Fine, layer_grid
from benchmarks.independent.presses import MM, Press, Shape
from benchmarks.independent.references import fine_zones, touched, way
from sim.indenters import Indenter
from sim.scene import Body, Scene

__all__ = ["Axial", "NotSolved", "press_of", "solved"]

# Shapes with an axis, by the name of the indenter.
SHAPES: dict[str, Shape] = {
    "sphere": "sphere", "sphere_s": "sphere", "torus": "torus", "flat_punch": "punch",
    "cylinder": "punch", "tube": "tube", "cylinder_sh": "tube", "cone": "cone",
    "rounded_cone": "cone",
}  # fmt: skip
# Elements along the contact's radius, their growth, and the steps of the tip, of both meshes.
FINE, COARSE = (12, 0.35, 16), (7, 0.5, 8)
# Factors on these steps, tried in turn.
STEPS = (1, 2, 4)
# Least uncertainty of a force, over the force: finer meshes differ by as much.
LEAST = 2e-3
# Steps of a motion in time, of both meshes and again, of the coarser one.
IN_TIME, AGAIN = 100, 200


@dataclass(frozen=True, slots=True)
class Axial:
    """A press with an axis of symmetry; lengths in [m]."""

    press: Press
    """Shape, friction and depths, for the fine zones of its meshes."""
    profile: profile.Profile
    body: Body
    depths: list[float]
    """Of each frame."""
    times: list[float]
    """[s]."""
    density: float
    """[kg/m^3]; 0: without inertia."""


def press_of(scene: Scene) -> Axial | None:
    """Return a scene as a press with an axis; None if it has none, is lifted, or is viscous."""
    body, effects = scene.body, scene.effects
    depths = [-tip[2] for tip in scene.motion.tip]
    on_axis = not any(x or y for x, y, _ in scene.motion.tip) and depths[0] == 0
    disc = body.footprint == "ellipse" and body.size_x == body.size_y
    only_down = all(one <= other for one, other in pairwise(depths))
    if not (on_axis and disc and only_down) or effects.viscosity or effects.gravity:
        return None
    shape = SHAPES.get(scene.indenter.name)
    if shape is None or any(scene.indenter.tilt) or scene.indenter.solid is not None:
        return None
    outline = _outline(scene.indenter, shape)
    if outline is None:
        return None
    measures, shown = outline
    press = Press(
        name="",
        shape=shape,
        measures=measures,
        path=tuple((0.0, 0.0, depth / MM) for depth in depths if depth > 0),
        size=(body.size_x / MM, body.size_y / MM, body.thickness / MM),
        friction=effects.friction.coefficient if effects.friction else 0.0,
        poisson=body.poisson,
    )
    density = body.density * effects.inertia.scale if effects.inertia else 0.0
    return Axial(press, shown, body, depths, list(scene.motion.time), density)


def _outline(indenter: Indenter, shape: Shape) -> tuple[tuple[float, ...], profile.Profile] | None:
    """Return the measures of a `Press`, and the profile; None if an edge is sharp."""
    values, edge = indenter.parts[0].values, indenter.edge_radius
    if shape == "sphere":
        return (values[1] / MM,), profile.sphere(values[1])
    if shape == "torus":
        return (values[0] / MM, values[1] / MM), profile.torus(values[0], values[1])
    if edge <= 0:
        return None
    if shape == "punch":
        return (values[2] / MM, edge / MM), profile.punch(values[2], edge)
    if shape == "tube":
        outer, inner = values[2] + values[3], values[2] - values[3]
        return (outer / MM, inner / MM, edge / MM), profile.tube(outer, inner, edge)
    angle = math.acos(values[0])
    flat = values[2] / values[0] - edge * (1 - math.sin(angle)) / math.cos(angle)
    tip = max(edge, values[2] / values[0])
    return (math.degrees(angle), tip / MM), profile.cone(angle, edge, max(flat, 0.0))


def solved(axial: Axial) -> tuple[Array, Array]:
    """Return the force of each frame (F, 3) [N], and its uncertainty (F,) [N].

    That is the difference from a mesh of half the elements (in time, also that from half as many
    steps, along which the force is extrapolated), and twice the overlap that is left.

    Raises:
        NotSolved: Newton's method did not converge.
    """
    if axial.density:
        down, unsure = _in_time(axial)
    else:
        down, unsure = _at_rest(axial)
    force = np.zeros((len(down), 3))
    force[:, 2] = -down
    return force, unsure


def _at_rest(axial: Axial) -> tuple[Array, Array]:
    depths = sorted({depth for depth in axial.depths if depth > 0})
    rows = [_answers(axial, depths, mesh) for mesh in (FINE, COARSE)]
    by_depth = {0.0: (0.0, 0.0)}
    for depth, fine, coarse in zip(depths, *rows, strict=True):
        error = abs(coarse.force - fine.force) + (LEAST + 2 * fine.penetration) * fine.force
        by_depth[depth] = fine.force, error
    pairs = np.array([by_depth[depth] for depth in axial.depths])
    return pairs[:, 0], pairs[:, 1]


def _answers(axial: Axial, depths: list[float], mesh: tuple[int, float, int]) -> list[Answer]:
    """Return the answer at each depth, in more steps if it takes them to pass a fold."""
    elements, growth, steps = mesh
    for times in STEPS[:-1]:
        with suppress(NotSolved):
            return _solver(axial, elements, growth).run(depths, way(axial.press, times * steps))
    return _solver(axial, elements, growth).run(depths, way(axial.press, STEPS[-1] * steps))


def _in_time(axial: Axial) -> tuple[Array, Array]:
    def forces(mesh: tuple[int, float, int], steps: int) -> Array:
        solver = _solver(axial, *mesh[:2])
        return np.array([0.0, *solver.in_time(axial.depths[1:], axial.times[1:], steps)])

    fine, coarse = forces(FINE, IN_TIME), forces(COARSE, IN_TIME)
    change = forces(COARSE, AGAIN) - coarse
    return fine + 2 * change, np.abs(fine - coarse) + np.abs(change) + LEAST * np.abs(fine)


def _solver(axial: Axial, elements: int, growth: float) -> AxisymmetricPress:
    body, press = axial.body, axial.press
    layer = Layer(body.size_x / 2, body.thickness, body.modulus, body.poisson)
    low, high = (edge * MM for edge in touched(press, max(press.depths)))
    zones = fine_zones(press, elements)
    if axial.profile.kind == "cone" and axial.profile.outer:
        edge = axial.profile.rounding
        high = press.measures[1] * MM + math.tan(axial.profile.half_angle) * max(axial.depths)
        zones = [Fine(0.0, 1.05 * high, min(high / elements, 4 * edge / elements))]
    grid = layer_grid(layer.radius, layer.thickness, zones, growth, body.dome_radius)
    wide = (high - low) / (1 if low == 0 else 2)
    return AxisymmetricPress(layer, axial.profile, grid, press.friction, wide, axial.density)
