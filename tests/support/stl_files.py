"""Small triangulated bodies and the files that contain them."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.indenters import named
from sim.indenters.outline import pieces

Array = NDArray[np.float64]
Faces = NDArray[np.int64]
# Vertices (V, 3) and triangles (F, 3), counterclockwise from outside.
Body = tuple[Array, Faces]

RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])


def write_binary(path: Path, body: Body) -> Path:
    vertices, faces = body
    records = np.zeros(len(faces), RECORD)
    records["corners"] = vertices[faces]
    path.write_bytes(bytes(80) + len(faces).to_bytes(4, "little") + records.tobytes())
    return path


def write_text(path: Path, body: Body) -> Path:
    vertices, faces = body
    lines = ["solid made up"]
    for corners in vertices[faces]:
        lines += ["  facet normal 0 0 0", "    outer loop"]
        lines += [f"      vertex {x:.9e} {y:.9e} {z:.9e}" for x, y, z in corners]
        lines += ["    endloop", "  endfacet"]
    path.write_text("\n".join([*lines, "endsolid made up", ""]))
    return path


def block(x: float, y: float, z: float) -> Body:
    """Return a box from z = 0 to z, centred over the origin."""
    cube = np.array([(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return (cube - [0.5, 0.5, 0]) * [x, y, z], _halved(quads)


def rounded_block(x: float, y: float, z: float, radius: float, count: int) -> Body:
    """Return the same with all edges rounded, by `count` (odd) strips in each direction."""
    vertices, faces = ball(1.0, count)
    half = np.array([x, y, z]) / 2 - radius
    return vertices * radius + np.sign(vertices) * half + [0, 0, z / 2], faces


def ball(radius: float, count: int) -> Body:
    """Return a sphere around the origin: an inflated cube of `count` x `count` squares per side."""
    corner = np.tan((np.arange(count + 1) / count - 0.5) * math.pi / 2)
    u, v = (axis.ravel() for axis in np.meshgrid(corner, corner, indexing="ij"))
    row = np.arange(count)[:, None] * (count + 1) + np.arange(count)
    quads = np.stack([row, row + count + 1, row + count + 2, row + 1], axis=-1).reshape(-1, 4)
    vertices, faces = [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            square = np.stack([u, v, np.full_like(u, side)], axis=1)
            faces.append((quads if side > 0 else quads[:, ::-1]) + len(vertices) * len(u))
            vertices.append(np.roll(square, axis + 1, axis=1))
    points = np.concatenate(vertices)
    points *= radius / np.linalg.norm(points, axis=1)[:, None]
    return points, _halved(np.concatenate(faces))


def revolved(profile: Sequence[tuple[float, float]], count: int) -> Body:
    """Return a closed outline (distance from axis, z), material on its left, revolved about z."""
    radius, z = np.array(profile, float).T
    ring = np.column_stack([*_circle(1.0, count).T, np.zeros(count)])
    rings = radius[:, None, None] * ring + z[:, None, None] * [0, 0, 1]
    return lofted([*rings, rings[0]])


def lofted(rings: Sequence[Array]) -> Body:
    """Return the surface between neighbouring closed rings of points (N, 3)."""
    count = len(rings[0])
    here = np.arange(len(rings) - 1)[:, None] * count
    this, after = np.arange(count), (np.arange(count) + 1) % count
    quads = [here + this, here + after, here + count + after, here + count + this]
    return np.concatenate(rings), _halved(np.stack(quads, axis=-1).reshape(-1, 4))


def extruded(outline: Array, height: float) -> Body:
    """Return the body from z = 0 to `height` over an anticlockwise outline (N, 2)."""
    count, left, ends = len(outline), list(range(len(outline))), []

    def turn(*corners: int) -> float:
        a, b, c = outline[list(corners)]
        return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))

    def is_ear(a: int, b: int, c: int) -> bool:
        others = [d for d in left if d not in (a, b, c)]
        within = (min(turn(a, b, d), turn(b, c, d), turn(c, a, d)) >= 0 for d in others)
        return turn(a, b, c) > 1e-9 and not any(within)

    while len(left) > 2:
        corners = zip(np.roll(left, 1), left, np.roll(left, -1), strict=True)
        ear = next((int(a), int(b), int(c)) for a, b, c in corners if is_ear(a, b, c))
        ends.append(ear)
        left.remove(ear[1])
    flat = np.array(ends)
    rings = [np.column_stack([outline, np.full(count, z)]) for z in (0.0, height)]
    vertices, walls = lofted(rings)
    return vertices, np.concatenate([walls, flat[:, ::-1], flat + count])


def turned_up(body: Body, up: float) -> Body:
    """Return a body along z laid along y, its y upwards and lower by `up`."""
    return np.roll(body[0], 1, axis=1)[:, [1, 0, 2]] * [1, -1, 1] - [0, 0, up], body[1]


def as_published(name: str, count: int) -> Body:
    """Return a named indenter [mm] of flat facets, `count` around a circle, with sharp edges."""
    top, quarter = 20.0, np.arange(count // 4 + 1) / (count // 4) * math.pi / 2
    if name in ("sphere", "sphere_s", "dots"):
        radius = {"sphere": 5.0, "sphere_s": 3.0, "dots": 1.0}[name]
        arc = [(radius * math.sin(t), radius * (1 - math.cos(t))) for t in quarter]
        body = revolved([*arc, (0, radius)], count)
        middles = [(3 * x, 3 * y, 0) for x, y in -_circle(1.0, 5)]
        return joined(*(moved(body, middle) for middle in middles)) if name == "dots" else body
    if name in ("cone", "cylinder", "cylinder_sh", "torus"):
        tube = np.column_stack([[3, 1.5]] * count).T + _circle(1.5, count, 0.5)
        profile = {
            "cone": [(0, 0), (0.5, 0), (4, 10), (0, 10)],
            "cylinder": [(0, 0), (3, 0), (3, top), (0, top)],
            "cylinder_sh": [(2.7, 0), (3.5, 0), (3.5, top), (2.7, top)],
            "torus": [(float(x), float(z)) for x, z in tube],
        }
        return revolved(profile[name], count)
    if name in ("hemisphere", "dotin"):
        angle = np.unique(np.append(np.arange(count) / count, np.arange(1, 8, 2) / 8)) * math.tau
        around = np.column_stack([np.cos(angle), np.sin(angle)])
        square = around / np.abs(around).max(axis=1)[:, None]
        plan = [7 * square * scale for scale in np.linspace(0, 1, 5)]
        low = [20 - np.sqrt(400 - (ring**2).sum(axis=1)) for ring in plan]
        if name == "dotin":
            plan = [*(2 * math.sin(t) * around for t in quarter), 4 * square]
            low = [*(np.full(len(angle), 2 * math.cos(t)) for t in quarter), 0 * angle]
        plan, low = [*plan, plan[-1], 0 * around], [*low, 0 * angle + top, 0 * angle + top]
        return lofted([np.column_stack(each) for each in zip(plan, low, strict=True)])
    if name == "cylinder_si":
        return moved(turned_up(extruded(_circle(3.0, count, 0.5), 14.0), -3.0), (0, 7, 0))
    if name in ("prism", "line"):
        return block(*{"prism": (5, 7), "line": (2, 16)}[name], top)
    outline = np.array(_outline(name, math.tau / count))
    body = extruded(outline, 14.0 if name == "wave" else top)
    return moved(turned_up(body, 0.0), (0, 7, 0)) if name == "wave" else body


def _circle(radius: float, count: int, shift: float = 0.0) -> Array:
    angle = (np.arange(count) + shift) / count * math.tau
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def _outline(name: str, step: float) -> list[tuple[float, float]]:
    """Return the path of a named indenter's first part [mm], arcs cut at about `step` [rad]."""
    corners = []
    for piece in pieces(named(name, 0.0).parts[0].values):
        turns = max(1, math.ceil(abs(piece.angle) / step - 1e-9))
        corners.append(piece.start)
        for angle in piece.angle * np.arange(1, turns) / turns:
            u, v = np.array(piece.start) - piece.centre
            sine, cosine = math.sin(angle), math.cos(angle)
            x, y = piece.centre
            corners.append((x + u * cosine - v * sine, y + u * sine + v * cosine))
    return [(1e3 * x, 1e3 * y) for x, y in corners]


def joined(*bodies: Body) -> Body:
    """Return bodies combined in one file."""
    first = np.cumsum([0] + [len(vertices) for vertices, _ in bodies])
    faces = [faces + start for (_, faces), start in zip(bodies, first, strict=False)]
    return np.concatenate([vertices for vertices, _ in bodies]), np.concatenate(faces)


def moved(body: Body, by: Sequence[float]) -> Body:
    return body[0] + np.array(by, float), body[1]


def _halved(quads: Sequence[Sequence[int]] | Faces) -> Faces:
    squares = np.asarray(quads)
    return np.concatenate([squares[:, [0, 1, 2]], squares[:, [0, 2, 3]]])
