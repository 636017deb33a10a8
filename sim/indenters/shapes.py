"""Indenters by their measures: spheres, punches, cones, boxes, tubes, and an infinite plane."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path

from sim.errors import SceneError, check_kind, check_range, plain
from sim.indenters.indenter import Indenter
from sim.indenters.outline import Part
from sim.indenters.solid import REACH, READERS, SPACING, Axis, Solid, Unit, Up, digest, with_edges

# The half-space above z = 0: the flat face of a punch.
TIP_PLANE = Part("side", "half_plane", (0.0, -1.0, 0.0))


def sphere(radius: float) -> Indenter:
    """Return a sphere [m]."""
    _check_length("sphere", "radius", radius)
    return Indenter("sphere", (Part("turned", "circle", (0.0, radius, radius), "union"),))


def torus(ring_radius: float, tube_radius: float) -> Indenter:
    """Return a flat-lying torus with the radii of its middle line and of its tube [m]."""
    _check_length("torus", "tube_radius", tube_radius)
    check_range("torus", "ring_radius", ring_radius, tube_radius, 1.0, unit="m")
    values = (ring_radius, tube_radius, tube_radius)
    return Indenter("torus", (Part("turned", "circle", values, "union"),))


def flat_punch(radius: float, edge_radius: float = 0.0) -> Indenter:
    """Return a flat, round punch [m]."""
    _check_length("flat_punch", "radius", radius)
    wall = Part("turned", "half_plane", (1.0, 0.0, radius), "union")
    return Indenter("flat_punch", (wall, TIP_PLANE), edge_radius)


def tube(outer_radius: float, inner_radius: float, edge_radius: float = 0.0) -> Indenter:
    """Return a flat ring, the end of a tube with these radii [m]."""
    _check_length("tube", "inner_radius", inner_radius)
    check_range("tube", "outer_radius", outer_radius, inner_radius, 1.0, unit="m", open_low=True)
    middle, half = (outer_radius + inner_radius) / 2, (outer_radius - inner_radius) / 2
    wall = Part("turned", "band", (1.0, 0.0, middle, half), "union")
    return Indenter("tube", (wall, TIP_PLANE), edge_radius)


def cone(half_angle: float, tip_radius: float = 0.0, edge_radius: float = 0.0) -> Indenter:
    """Return a cone at `half_angle` [rad] from its axis, with a flat round tip [m].

    With the largest edge radius that fits, the tip is a sphere tangent to the side: see
    `rounded_cone`.
    """
    _check_half_angle(half_angle)
    check_range("cone", "tip_radius", tip_radius, 0.0, 1.0, unit="m")
    cosine, sine = math.cos(half_angle), math.sin(half_angle)
    side = Part("turned", "half_plane", (cosine, -sine, tip_radius * cosine), "union", cosine=sine)
    tip = Part("side", "half_plane", (0.0, -1.0, 0.0), cosine=sine)
    return Indenter("cone", (side, tip), edge_radius)


def rounded_cone(half_angle: float, tip_radius: float) -> Indenter:
    """Return a cone at `half_angle` [rad] from its axis with a spherical tip [m]."""
    _check_half_angle(half_angle)
    _check_length("rounded_cone", "tip_radius", tip_radius)
    sine = math.sin(half_angle)
    flat = tip_radius * math.sqrt((1 - sine) / (1 + sine))
    sharp = cone(half_angle, flat)
    return Indenter("rounded_cone", sharp.parts, min(tip_radius, sharp.edge_radius_max))


def box(width: float, length: float, edge_radius: float = 0.0) -> Indenter:
    """Return a flat rectangle, `width` along x and `length` along y [m]."""
    return Indenter("box", (*block(width, length), TIP_PLANE), edge_radius)


def bar(radius: float, length: float, edge_radius: float = 0.0) -> Indenter:
    """Return a round bar along y [m]."""
    _check_length("bar", "radius", radius)
    _check_length("bar", "length", length)
    round_side = Part("side", "circle", (0.0, radius, radius), "union")
    ends = Part("plan", "band", (0.0, 1.0, 0.0, length / 2))
    return Indenter("bar", (round_side, ends), edge_radius)


def extruded(values: Sequence[float], edge_radius: float = 0.0) -> Indenter:
    """Return a flat punch with the outline of a path in x and y (see `Part.values`)."""
    outline = Part("plan", "path", plain(values), "union")
    return Indenter("extruded", (outline, TIP_PLANE), edge_radius)


def plane() -> Indenter:
    """Return an infinite plane, for confined compression."""
    return Indenter("plane", (Part("side", "half_plane", (0.0, -1.0, 0.0), "union"),))


def block(width: float, length: float) -> tuple[Part, Part]:
    """Return the four upright walls of a rectangle, `width` along x and `length` along y [m]."""
    _check_length("box", "width", width)
    _check_length("box", "length", length)
    return (
        Part("plan", "band", (1.0, 0.0, 0.0, width / 2), "union"),
        Part("plan", "band", (0.0, 1.0, 0.0, length / 2)),
    )


def bulge(
    start: tuple[float, float], through: tuple[float, float], end: tuple[float, float]
) -> float:
    """Return the bulge of the arc from `start` through `through` to `end`.

    The angle between the two chords is half that of the arc (inscribed angle).
    """
    before = through[0] - start[0], through[1] - start[1]
    after = end[0] - through[0], end[1] - through[1]
    cross = before[0] * after[1] - before[1] * after[0]
    along = before[0] * after[0] + before[1] * after[1]
    if cross == 0 and along <= 0:
        raise SceneError(f"bulge: {start!r}, {through!r}, {end!r}; allowed: 3 different points")
    return math.tan(math.atan2(cross, along) / 2)


def _check_half_angle(value: float) -> None:
    check_range("cone", "half_angle", value, 0.0, math.radians(85), unit="rad")


def _check_length(owner: str, name: str, value: float) -> None:
    check_range(owner, name, value, 0.0, 1.0, unit="m", open_low=True)


# The 18 indenters of GenForce by name, as measured from its published meshes.

MM = 1e-3


def named(name: str, edge_radius: float | None = None) -> Indenter:
    """Return the indenter of that name; `edge_radius` [m] replaces its default, 0 for sharp edges.

    Raises:
        SceneError: The name is unknown, or the edge radius does not fit the shape.
    """
    if not isinstance(name, str) or name not in _TABLE:
        raise SceneError(f"indenter: {name!r}; allowed: {', '.join(NAMES)}")
    make, radius_mm = _TABLE[name]
    radius = radius_mm * MM if edge_radius is None else edge_radius
    return replace(make(), name=name, edge_radius=radius)


def _hemisphere() -> Indenter:
    """Return a cap of radius 20, cut to a square 14 wide."""
    radius, width = 20 * MM, 14 * MM
    # Along each whole wall, the cap's normal has the same component towards it.
    lean = width / 2 / radius
    cap = Part("turned", "circle", (0.0, radius, radius), cosine=lean)
    return Indenter("hemisphere", (*block(width, width), cap))


def _dotin() -> Indenter:
    """Return a block with a hemispherical recess in the middle."""
    recess = Part("turned", "circle", (0.0, 0.0, 2 * MM), "subtract")
    parts = (*block(8 * MM, 8 * MM), TIP_PLANE, recess)
    return Indenter("dotin", parts, narrowest=2 * MM)


def dots_on_plate(
    count: int, radius: float, away: float, begin: float, *, drop: float, width: float
) -> Indenter:
    """Return hemispheres on a circle `away` from the axis, the first at an angle `begin` [rad].

    Their square plate, `width` wide, is `drop` above their tips; lengths in [m].
    """
    plate = replace(TIP_PLANE, values=(0.0, -1.0, -drop))
    angles = [begin + index * math.tau / count for index in range(count)]
    axes = [(away * math.cos(angle), away * math.sin(angle)) for angle in angles]
    dots = [Part("turned", "circle", (0.0, radius, radius), "union", axis=axis) for axis in axes]
    return Indenter("dots", (*block(width, width), plate, *dots))


def _wave() -> Indenter:
    """Return two round ridges along y with a groove between, shoulders 2 and 1 above the tips."""
    left, left_radius = (-2.2, 3.0), 3.0
    right, right_radius = (2.45, 2.0), 2.0
    groove_radius = 0.5
    # The distance from the groove's centre to a ridge's centre is the sum of their radii.
    base = math.dist(left, right)
    far, near = left_radius + groove_radius, right_radius + groove_radius
    along = (far**2 - near**2 + base**2) / (2 * base)
    down = math.sqrt(far**2 - along**2)
    step = (right[0] - left[0]) / base, (right[1] - left[1]) / base
    groove = left[0] + along * step[0] + down * step[1], left[1] + along * step[1] - down * step[0]
    enter = _between(left, groove, left_radius / far)
    leave = _between(right, groove, right_radius / near)
    foot_left = left[0] - math.sqrt(left_radius**2 - 1), 2.0
    foot_right = right[0] + math.sqrt(right_radius**2 - 1), 1.0
    path = [
        (-7.0, 2.0, 0.0),
        (*foot_left, bulge(foot_left, (left[0], 0.0), enter)),
        (*enter, bulge(enter, (groove[0], groove[1] + groove_radius), leave)),
        (*leave, bulge(leave, (right[0], 0.0), foot_right)),
        (*foot_right, 0.0),
        (7.0, 1.0, 0.0),
        (7.0, 10.0, 0.0),
        (-7.0, 10.0, 0.0),
    ]
    profile = Part("side", "path", _metres(path), "union")
    ends = Part("plan", "band", (0.0, 1.0, 0.0, 7 * MM))
    return Indenter("wave", (profile, ends))


def _hexagon() -> Indenter:
    """Return a regular hexagon with corners on x."""
    angles = [corner * math.tau / 6 for corner in range(6)]
    return _flat([(3.5 * math.cos(angle), 3.5 * math.sin(angle), 0.0) for angle in angles])


def _triangle() -> Indenter:
    """Return a triangle whose sharpest corner is 26 degrees."""
    return _flat([(3.5, -2.5, 0.0), (0.5, 2.5, 0.0), (-3.5, 1.98, 0.0)])


def _pacman() -> Indenter:
    """Return a disc without a sector of 70 degrees that opens towards x."""
    lip = 3 * math.cos(math.radians(35)), 3 * math.sin(math.radians(35))
    round_back = math.tan(math.radians(290) / 4)
    return _flat([(0.0, 0.0, 0.0), (*lip, round_back), (lip[0], -lip[1], 0.0)])


def _moon() -> Indenter:
    """Return a disc without a smaller, eccentric one."""
    outer, inner, shift = 3.5, 2.7, 1.7
    horn_x = (outer**2 - inner**2 + shift**2) / (2 * shift)
    horn_y = math.sqrt(outer**2 - horn_x**2)
    upper, lower = (horn_x, horn_y), (horn_x, -horn_y)
    back = bulge(upper, (-outer, 0.0), lower)
    hollow = bulge(lower, (shift - inner, 0.0), upper)
    return _flat([(*upper, back), (*lower, hollow)])


def _random() -> Indenter:
    """Return an irregular outline with a round corner and a round bay."""
    corner = bulge((0.77, -1.84), (2.23, -2.18), (3.02, -0.91))
    bay = bulge((-2.57, -0.92), (-1.13, 0.49), (-0.06, -0.13))
    return _flat(
        [
            (0.77, -1.84, corner),
            (3.02, -0.91, 0.0),
            (1.80, 0.49, 0.0),
            (3.61, 0.86, 0.0),
            (2.12, 2.34, 0.0),
            (-3.12, 1.20, 0.0),
            (-3.37, -0.74, 0.0),
            (-2.57, -0.92, bay),
            (-0.06, -0.13, 0.0),
        ]
    )


def _flat(corners_mm: list[tuple[float, float, float]]) -> Indenter:
    return extruded(_metres(corners_mm))


def _metres(corners_mm: list[tuple[float, float, float]]) -> tuple[float, ...]:
    return tuple(value for u, v, turn in corners_mm for value in (u * MM, v * MM, turn))


def _between(
    start: tuple[float, float], end: tuple[float, float], fraction: float
) -> tuple[float, float]:
    return start[0] + fraction * (end[0] - start[0]), start[1] + fraction * (end[1] - start[1])


# Edge radius [mm]. A mesh finer than the radius gives reproducible solutions, a sharp edge never
# does, so all have one. It is 0.3 if there is room, and 0.2 if that would cut into essential
# features: the flat tip of the cone (radius 0.5), the tube's wall (0.8 wide), the narrow corners of
# triangle and moon, which lose radius / sin(half their angle) in length. Round tips have no edge.
_TABLE: dict[str, tuple[Callable[[], Indenter], float]] = {
    "sphere": (lambda: sphere(5 * MM), 0.0),
    "sphere_s": (lambda: sphere(3 * MM), 0.0),
    "hemisphere": (_hemisphere, 0.3),
    "cone": (lambda: cone(math.atan(0.35), 0.5 * MM), 0.2),
    "cylinder": (lambda: flat_punch(3 * MM), 0.3),
    "cylinder_sh": (lambda: tube(3.5 * MM, 2.7 * MM), 0.2),
    "cylinder_si": (lambda: bar(3 * MM, 14 * MM), 0.3),
    "torus": (lambda: torus(3 * MM, 1.5 * MM), 0.0),
    "dotin": (_dotin, 0.3),
    "dots": (lambda: dots_on_plate(5, MM, 3 * MM, math.pi, drop=MM, width=14 * MM), 0.3),
    "wave": (_wave, 0.3),
    "prism": (lambda: box(5 * MM, 7 * MM), 0.3),
    "line": (lambda: box(2 * MM, 16 * MM), 0.3),
    "hexagon": (_hexagon, 0.3),
    "triangle": (_triangle, 0.2),
    "pacman": (_pacman, 0.3),
    "moon": (_moon, 0.2),
    "random": (_random, 0.3),
}
# Names that `named` accepts.
NAMES: tuple[str, ...] = tuple(_TABLE)


# An indenter from any STL file, or of the parts in a YAML file.


def from_stl(
    path: str | PathLike[str],
    *,
    unit: Unit = "mm",
    up: Up = "+z",
    axis: Axis | None = None,
    edge_radius: float | None = None,
    spacing: float | None = None,
    reach: float = REACH,
    name: str | None = None,
) -> Indenter:
    """Return the body in an STL file, or of a YAML file's parts, with its lowest point at z = 0.

    The file is read and checked and distances to the body are computed immediately, which takes
    seconds. A stored scene contains the file's path and digest, and reads the file again when it is
    simulated. `indenter.solid.notes` lists repairs, suspicious features, and parts that are thinner
    than the edges allow.

    Facets at small angles to each other are read as the curved surface through their corners. A
    named indenter as a file of such facets, with sharp edges, gives the same forces within 1 %.

    Args:
        path: The file, an STL file, binary or text, or a YAML file with `parts` (`assembled`).
        unit: Unit of its numbers.
        up: Axis of the file that points away from the skin; "-z" if its tip is up.
        axis: Origin of x and y: the `middle` of the bounding box, as by default of an STL file, or
            that of the `file`, as by default of parts.
        edge_radius: Least radius of every convex edge [m]: sharper edges get it, rounder ones in
            the file are unchanged; with 0, edges are as sharp as the grid resolves. By default it
            is that of the named indenters: 0.3 mm, or less (0.2, 0.15, 0.1, 0.05 mm) to leave thin
            parts and narrow corners, or 0 if all edges in the file are round. What it changes in
            the force is then part of the result's error.
        spacing: Spacing of the grid of distances [m]; by default 0.1 mm, or less for a small edge
            radius.
        reach: Height above the tip up to which the body is sampled [m], more than a press's depth.
        name: Name of the indenter for messages; by default the file's name.

    Raises:
        FileNotFoundError: The file does not exist.
        SceneError: The file is truncated or holds no watertight body of a plausible size, or the
            body has no room for the edge radius.
    """
    check_kind("path", path, str | PathLike, "the path of a file")
    file = Path(path).resolve()
    step = SPACING if spacing is None else spacing
    axis = axis or ("file" if file.suffix in READERS else "middle")
    solid = Solid(str(file), digest(file.read_bytes()), unit, up, axis, step, reach)
    indenter = Indenter(name or file.stem, edge_radius=edge_radius or 0.0, solid=solid)
    solid = with_edges(solid, edge_radius, spacing)
    return replace(indenter, edge_radius=indenter.edge_radius or solid.unasked, solid=solid)
