"""Randomly drawn indenters: all types that can be built of parts, and solids from STL files."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh

from benchmarks.hard_cases.random_scenes.dice import Dice, rounded
from sim.indenters import NAMES, Indenter, Part, from_stl, named, shapes

MM = 1e-3
# Relative frequency of each kind.
KINDS: dict[str, float] = {
    "sphere": 4, "named": 6, "blade": 3, "box": 2, "punch": 2, "cone": 2, "rounded_cone": 1.5,
    "tube": 1.5, "torus": 1.5, "bar": 3, "polygon": 1.5, "composed": 2, "stl": 1.5,
}  # fmt: skip
# Maximum tilt [rad], just below the allowed 30 degrees.
TILT_MAX = 0.5


def draw_shape(dice: Dice, unit: float, folder: Path) -> Indenter:
    """Return an indenter for a body about 4 `unit` [m] thick; STL files go to `folder`."""
    kind = dice.kind(KINDS)
    indenter = _frustum(dice, folder) if kind == "stl" else _of_parts(kind, dice, unit)
    if dice.chance(0.25):
        dice.words.append("tilted")
        size = dice.one_of([0.01, 0.1, 0.3, TILT_MAX])
        indenter = indenter.tilted(*_turned(size, dice.even(0.0, math.tau)))
    return indenter


def _of_parts(kind: str, dice: Dice, unit: float) -> Indenter:
    if kind == "sphere":
        return shapes.sphere(unit * dice.scaled(0.5, 8.0))
    if kind == "named":
        return named(dice.one_of(NAMES), None if dice.chance(0.85) else 0.0)
    if kind == "blade":
        return blade(dice, unit)
    if kind == "box":
        return _with_edge(dice, shapes.box(unit * dice.even(1.5, 8.0), unit * dice.even(1.5, 8.0)))
    if kind == "punch":
        return _with_edge(dice, shapes.flat_punch(unit * dice.scaled(0.7, 5.0)))
    if kind == "cone":
        tip = unit * dice.even(0.2, 1.0)
        return _with_edge(dice, shapes.cone(math.radians(dice.even(10.0, 75.0)), tip))
    if kind == "rounded_cone":
        return shapes.rounded_cone(math.radians(dice.even(10.0, 75.0)), unit * dice.scaled(0.2, 2))
    if kind == "tube":
        outer, wall = unit * dice.even(1.5, 5.0), unit * dice.even(0.3, 1.4)
        return shapes.tube(outer, outer - wall, _edge(dice, wall / 2))
    if kind == "torus":
        tube = unit * dice.even(0.4, 1.5)
        return shapes.torus(tube + unit * dice.even(0.2, 3.0), tube)
    if kind == "bar":
        radius, length = unit * dice.scaled(0.15, 4.0), unit * dice.even(2.0, 14.0)
        return shapes.bar(radius, length, _edge(dice, radius / 2))
    if kind == "polygon":
        return _polygon(dice, unit)
    return _composed(dice, unit)


def blade(dice: Dice, unit: float) -> Indenter:
    """Return a narrow box, 0.3 to 1 mm by 6 to 14 mm at a unit of 1 mm, along x or y."""
    width, length = unit * dice.even(0.3, 1.0), unit * dice.even(6.0, 14.0)
    edge = rounded(width * dice.one_of([0.1, 0.25, 0.4, 0.48]))
    if dice.chance(0.5):
        width, length = length, width
    return replace(shapes.box(rounded(width), rounded(length), edge), name="blade")


def _with_edge(dice: Dice, sharp: Indenter) -> Indenter:
    return replace(sharp, edge_radius=_edge(dice, sharp.edge_radius_max))


def _edge(dice: Dice, most: float) -> float:
    """Return an edge radius: usually a fraction of the maximum, sometimes zero or the maximum."""
    return min(most, 1.0) * dice.weighted({0.0: 1, 0.1: 2, 0.3: 4, 0.6: 3, 1.0: 1})


def _turned(radius: float, angle: float) -> tuple[float, float]:
    return rounded(radius * math.cos(angle)), rounded(radius * math.sin(angle))


def _polygon(dice: Dice, unit: float) -> Indenter:
    """Return a flat punch with 3 to 8 corners around its middle, some sharp, some concave."""
    corners = dice.whole(3, 8)
    values: list[float] = []
    for corner in range(corners):
        angle = math.tau * (corner + 0.6 * (dice.even(0.0, 1.0) - 0.5)) / corners
        values += [*_turned(unit * dice.even(2.0, 5.0), angle), 0.0]
    return _with_edge(dice, replace(shapes.extruded(values), name="polygon"))


def _composed(dice: Dice, unit: float) -> Indenter:
    """Return spheres on a plate, a bar with a sphere, or a block with a recess."""
    which = dice.whole(0, 2)
    if which == 0:
        count, ring = dice.whole(2, 5), unit * dice.even(1.5, 4.0)
        (dot,) = shapes.sphere(radius := unit * dice.even(0.5, 1.5)).parts
        turns = [corner * math.tau / count for corner in range(count)]
        dots = [replace(dot, axis=_turned(ring, turn)) for turn in turns]
        width = 2 * (ring + radius)
        plate = Part("side", "half_plane", (0.0, -1.0, -unit * dice.even(0.5, 2.0)))
        return Indenter("dots", (*shapes.block(width, width), plate, *dots))
    if which == 1:
        bar = shapes.bar(unit * dice.even(0.5, 1.5), unit * dice.even(6.0, 12.0))
        return Indenter("cross", (*bar.parts, *shapes.sphere(unit * dice.even(1, 3)).parts))
    size, recess = unit * dice.even(5.0, 9.0), unit * dice.even(1.0, 2.0)
    hollow = Part("turned", "circle", (0.0, 0.0, recess), "subtract")
    parts = (*shapes.block(size, size), shapes.TIP_PLANE, hollow)
    narrowest = size / 2 - recess
    return Indenter("hollow", parts, rounded(narrowest * dice.even(0.1, 0.4)), narrowest)


def _frustum(dice: Dice, folder: Path) -> Indenter:
    """Return the frustum of a pyramid, read from an STL file in mm."""
    below, above = dice.even(2.0, 6.0), dice.even(5.0, 9.0)
    sides = dice.whole(3, 8)
    edge = dice.one_of([0.32, 0.5]) * MM
    path = folder / f"frustum-{sides}-{below:g}-{above:g}.stl"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        angle = np.arange(sides) / sides * math.tau
        ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(sides)])
        corners = np.concatenate([below * ring, above * ring + [0.0, 0.0, 8.0]])
        trimesh.convex.convex_hull(corners).export(path)
    return from_stl(path, edge_radius=edge, spacing=0.2 * MM, axis="file")
