"""Indenters by their measures: spheres, punches, cones, boxes, tubes, and a plane without end."""

from __future__ import annotations

import math
from collections.abc import Sequence

from sim.checks import check_range
from sim.errors import SceneError
from sim.indenters.indenter import Indenter
from sim.indenters.part import Part

TIP_PLANE = Part("side", "half_plane", (0.0, -1.0, 0.0))
"""Everything above z = 0: the flat face of a punch."""


def sphere(radius: float, *, name: str = "sphere") -> Indenter:
    """A sphere [m]."""
    _check_length("sphere", "radius", radius)
    return Indenter(name, (Part("turned", "circle", (0.0, radius, radius), "union"),))


def torus(ring_radius: float, tube_radius: float, *, name: str = "torus") -> Indenter:
    """A ring lying flat: the radius of its middle line and of its tube [m]."""
    _check_length("torus", "tube_radius", tube_radius)
    check_range("torus", "ring_radius", ring_radius, tube_radius, 1.0, unit="m")
    values = (ring_radius, tube_radius, tube_radius)
    return Indenter(name, (Part("turned", "circle", values, "union"),))


def flat_punch(radius: float, edge_radius: float = 0.0, *, name: str = "flat_punch") -> Indenter:
    """A flat, round punch [m]."""
    _check_length("flat_punch", "radius", radius)
    wall = Part("turned", "half_plane", (1.0, 0.0, radius), "union")
    return Indenter(name, (wall, TIP_PLANE), edge_radius)


def tube(
    outer_radius: float, inner_radius: float, edge_radius: float = 0.0, *, name: str = "tube"
) -> Indenter:
    """A flat ring: the end of a tube with these radii [m]."""
    _check_length("tube", "inner_radius", inner_radius)
    check_range("tube", "outer_radius", outer_radius, inner_radius, 1.0, unit="m", open_low=True)
    middle, half = (outer_radius + inner_radius) / 2, (outer_radius - inner_radius) / 2
    wall = Part("turned", "band", (1.0, 0.0, middle, half), "union")
    return Indenter(name, (wall, TIP_PLANE), edge_radius)


def cone(
    half_angle: float, tip_radius: float = 0.0, edge_radius: float = 0.0, *, name: str = "cone"
) -> Indenter:
    """A cone whose side stands at `half_angle` [rad] from its axis, on a flat round tip [m].

    With the largest edge radius that the tip has room for, the tip is a sphere tangent to the side:
    see `rounded_cone`.
    """
    check_range("cone", "half_angle", half_angle, 0.0, math.radians(85))
    check_range("cone", "tip_radius", tip_radius, 0.0, 1.0, unit="m")
    cosine, sine = math.cos(half_angle), math.sin(half_angle)
    side = Part("turned", "half_plane", (cosine, -sine, tip_radius * cosine), "union", cosine=sine)
    tip = Part("side", "half_plane", (0.0, -1.0, 0.0), cosine=sine)
    return Indenter(name, (side, tip), edge_radius)


def rounded_cone(half_angle: float, tip_radius: float, *, name: str = "rounded_cone") -> Indenter:
    """A cone at `half_angle` [rad] from its axis with a spherical tip of `tip_radius` [m]."""
    _check_length("rounded_cone", "tip_radius", tip_radius)
    sine = math.sin(half_angle)
    flat = tip_radius * math.sqrt((1 - sine) / (1 + sine))
    sharp = cone(half_angle, flat, name=name)
    return Indenter(name, sharp.parts, min(tip_radius, sharp.edge_radius_max))


def box(width: float, length: float, edge_radius: float = 0.0, *, name: str = "box") -> Indenter:
    """A flat rectangle, `width` along x and `length` along y [m]."""
    return Indenter(name, (*block(width, length), TIP_PLANE), edge_radius)


def bar(radius: float, length: float, edge_radius: float = 0.0, *, name: str = "bar") -> Indenter:
    """A round bar lying along y [m]."""
    _check_length("bar", "radius", radius)
    _check_length("bar", "length", length)
    round_side = Part("side", "circle", (0.0, radius, radius), "union")
    ends = Part("plan", "band", (0.0, 1.0, 0.0, length / 2))
    return Indenter(name, (round_side, ends), edge_radius)


def extruded(
    values: Sequence[float], edge_radius: float = 0.0, *, name: str = "extruded"
) -> Indenter:
    """A flat punch with the outline of a path in x and y (see `Part.values`)."""
    outline = Part("plan", "path", tuple(float(value) for value in values), "union")
    return Indenter(name, (outline, TIP_PLANE), edge_radius)


def plane() -> Indenter:
    """A flat without end: confined compression."""
    return Indenter("plane", (Part("side", "half_plane", (0.0, -1.0, 0.0), "union"),))


def block(width: float, length: float) -> tuple[Part, Part]:
    """The four upright walls of a rectangle, `width` along x and `length` along y [m]."""
    _check_length("box", "width", width)
    _check_length("box", "length", length)
    return (
        Part("plan", "band", (1.0, 0.0, 0.0, width / 2), "union"),
        Part("plan", "band", (0.0, 1.0, 0.0, length / 2)),
    )


def bulge(
    start: tuple[float, float], through: tuple[float, float], end: tuple[float, float]
) -> float:
    """Bulge of the arc from `start` by way of `through` to `end`.

    The chords to and from the middle point turn by half of what the arc turns (inscribed angle).
    """
    before = through[0] - start[0], through[1] - start[1]
    after = end[0] - through[0], end[1] - through[1]
    cross = before[0] * after[1] - before[1] * after[0]
    along = before[0] * after[0] + before[1] * after[1]
    if cross == 0 and along <= 0:
        raise SceneError(f"bulge: {start!r}, {through!r}, {end!r}; allowed: 3 different points")
    return math.tan(math.atan2(cross, along) / 2)


def _check_length(owner: str, name: str, value: float) -> None:
    check_range(owner, name, value, 0.0, 1.0, unit="m", open_low=True)
