"""Small triangulated bodies and the files that contain them."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sim.indenters import parts

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
    angle = np.arange(count) / count * math.tau
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])
    rings = radius[:, None, None] * ring + z[:, None, None] * [0, 0, 1]
    return lofted([*rings, rings[0]])


def lofted(rings: Sequence[Array]) -> Body:
    """Return the surface between neighbouring closed rings of points (N, 3)."""
    count = len(rings[0])
    here = np.arange(len(rings) - 1)[:, None] * count
    this, after = np.arange(count), (np.arange(count) + 1) % count
    quads = [here + this, here + after, here + count + after, here + count + this]
    return np.concatenate(rings), _halved(np.stack(quads, axis=-1).reshape(-1, 4))


def as_published(name: str, count: int) -> Body:
    """Return a named indenter [mm] of flat facets, `count` around a circle, with sharp edges."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(parts, "FACETS", count)
        return parts.assembled(f"parts: [{{shape: {name}}}]".encode(), name)


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
