"""The 18 indenters of GenForce by name, as measured from its published meshes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from sim.errors import SceneError
from sim.indenters import shapes
from sim.indenters.indenter import Indenter
from sim.indenters.part import Part

MM = 1e-3


def named(name: str, edge_radius: float | None = None) -> Indenter:
    """The indenter of that name; `edge_radius` [m] in place of its own, 0 for sharp edges.

    Raises:
        SceneError: No such name, or an edge radius that the shape has no room for.
    """
    if name not in _TABLE:
        raise SceneError(f"indenter: {name!r}; allowed: {', '.join(NAMES)}")
    make, radius_mm = _TABLE[name]
    radius = radius_mm * MM if edge_radius is None else edge_radius
    return replace(make(), name=name, edge_radius=radius)


def _hemisphere() -> Indenter:
    """A cap of radius 20, cut to a square 14 wide."""
    radius, width = 20 * MM, 14 * MM
    # Along the whole of each wall the cap's normal leans by the same share towards it.
    lean = width / 2 / radius
    cap = Part("turned", "circle", (0.0, radius, radius), cosine=lean)
    return Indenter("hemisphere", (*shapes.block(width, width), cap))


def _dotin() -> Indenter:
    """A block with a hemispherical recess in the middle."""
    recess = Part("turned", "circle", (0.0, 0.0, 2 * MM), "subtract")
    parts = (*shapes.block(8 * MM, 8 * MM), shapes.TIP_PLANE, recess)
    return Indenter("dotin", parts, narrowest=2 * MM)


def _dots() -> Indenter:
    """Five hemispheres on a pentagon, on a plate 1 above their tips."""
    plate = Part("side", "half_plane", (0.0, -1.0, -1 * MM))
    dots = tuple(
        Part(
            "turned",
            "circle",
            (0.0, 1 * MM, 1 * MM),
            "union",
            axis=(3 * MM * math.cos(angle), 3 * MM * math.sin(angle)),
        )
        for angle in (math.pi + corner * math.tau / 5 for corner in range(5))
    )
    return Indenter("dots", (*shapes.block(14 * MM, 14 * MM), plate, *dots))


def _wave() -> Indenter:
    """Two round ridges along y with a groove between them, on shoulders 2 and 1 above the tips."""
    left, left_radius = (-2.2, 3.0), 3.0
    right, right_radius = (2.45, 2.0), 2.0
    groove_radius = 0.5
    # The groove's centre keeps its own radius and a ridge's away from that ridge's centre.
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
        (*foot_left, shapes.bulge(foot_left, (left[0], 0.0), enter)),
        (*enter, shapes.bulge(enter, (groove[0], groove[1] + groove_radius), leave)),
        (*leave, shapes.bulge(leave, (right[0], 0.0), foot_right)),
        (*foot_right, 0.0),
        (7.0, 1.0, 0.0),
        (7.0, 10.0, 0.0),
        (-7.0, 10.0, 0.0),
    ]
    profile = Part("side", "path", _metres(path), "union")
    ends = Part("plan", "band", (0.0, 1.0, 0.0, 7 * MM))
    return Indenter("wave", (profile, ends))


def _hexagon() -> Indenter:
    """A regular hexagon with corners on x."""
    angles = [corner * math.tau / 6 for corner in range(6)]
    return _flat([(3.5 * math.cos(angle), 3.5 * math.sin(angle), 0.0) for angle in angles])


def _triangle() -> Indenter:
    """Three corners, the sharpest 26 degrees."""
    return _flat([(3.5, -2.5, 0.0), (0.5, 2.5, 0.0), (-3.5, 1.98, 0.0)])


def _pacman() -> Indenter:
    """A disc less a mouth of 70 degrees that opens towards x from the centre."""
    lip = 3 * math.cos(math.radians(35)), 3 * math.sin(math.radians(35))
    round_back = math.tan(math.radians(290) / 4)
    return _flat([(0.0, 0.0, 0.0), (*lip, round_back), (lip[0], -lip[1], 0.0)])


def _moon() -> Indenter:
    """A disc less a smaller one beside its centre."""
    outer, inner, shift = 3.5, 2.7, 1.7
    horn_x = (outer**2 - inner**2 + shift**2) / (2 * shift)
    horn_y = math.sqrt(outer**2 - horn_x**2)
    upper, lower = (horn_x, horn_y), (horn_x, -horn_y)
    back = shapes.bulge(upper, (-outer, 0.0), lower)
    hollow = shapes.bulge(lower, (shift - inner, 0.0), upper)
    return _flat([(*upper, back), (*lower, hollow)])


def _random() -> Indenter:
    """An irregular outline with a round corner and a round bay."""
    corner = shapes.bulge((0.77, -1.84), (2.23, -2.18), (3.02, -0.91))
    bay = shapes.bulge((-2.57, -0.92), (-1.13, 0.49), (-0.06, -0.13))
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
    return shapes.extruded(_metres(corners_mm))


def _metres(corners_mm: list[tuple[float, float, float]]) -> tuple[float, ...]:
    return tuple(value for u, v, turn in corners_mm for value in (u * MM, v * MM, turn))


def _between(
    start: tuple[float, float], end: tuple[float, float], share: float
) -> tuple[float, float]:
    return start[0] + share * (end[0] - start[0]), start[1] + share * (end[1] - start[1])


# Edge radius [mm]: a skin finer than the radius is solved reproducibly, a sharp edge never, so all
# have one. 0.3 where there is room; 0.2 where it would cut into what makes the shape: the flat tip
# of the cone (radius 0.5), the tube's wall (0.8 wide), the narrow corners of triangle and moon,
# which lose radius / sin(half their angle) of their length. Round tips have no edge.
_TABLE: dict[str, tuple[Callable[[], Indenter], float]] = {
    "sphere": (lambda: shapes.sphere(5 * MM), 0.0),
    "sphere_s": (lambda: shapes.sphere(3 * MM), 0.0),
    "hemisphere": (_hemisphere, 0.3),
    "cone": (lambda: shapes.cone(math.atan(0.35), 0.5 * MM), 0.2),
    "cylinder": (lambda: shapes.flat_punch(3 * MM), 0.3),
    "cylinder_sh": (lambda: shapes.tube(3.5 * MM, 2.7 * MM), 0.2),
    "cylinder_si": (lambda: shapes.bar(3 * MM, 14 * MM), 0.3),
    "torus": (lambda: shapes.torus(3 * MM, 1.5 * MM), 0.0),
    "dotin": (_dotin, 0.3),
    "dots": (_dots, 0.3),
    "wave": (_wave, 0.3),
    "prism": (lambda: shapes.box(5 * MM, 7 * MM), 0.3),
    "line": (lambda: shapes.box(2 * MM, 16 * MM), 0.3),
    "hexagon": (_hexagon, 0.3),
    "triangle": (_triangle, 0.2),
    "pacman": (_pacman, 0.3),
    "moon": (_moon, 0.2),
    "random": (_random, 0.3),
}
NAMES: tuple[str, ...] = tuple(_TABLE)
"""The names that `named` knows."""
