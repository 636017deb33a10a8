"""Curved surfaces of a body from the flat facets that its file has for them."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sim.arrays import Array

Whole = NDArray[np.int64]

# Angles between facets of one curved surface [rad]: below the first they are one plane; beyond the
# second, as drawings programs never export them, they meet at an edge.
PLANE, BENT = math.radians(0.05), math.radians(30.5)
# Largest distance of a curved surface from its facets [m]; beyond, they are meant flat.
BULGE_MOST = 0.12e-3
# Distance from the curved surface of the facets that are returned [m], and most per edge.
CLOSE, PARTS_MOST = 1e-6, 16
# A facet is a plane where it is this many times larger than each that bends away from it.
LARGER = 4.0
# Least and largest angle between two facets, over the next one of a curved surface.
ALIKE, SHARPER = 0.4, 1.3
# The same beside a plane that goes over into the curved surface: about half.
HALVED = 0.75
# Breadth of a facet over that of its neighbours beyond which it is a plane, not a ring.
BROADER = 2.0
# A tangent that leaves a facet's side by more than this, over its length, is not of that side.
ASIDE = 0.4


def curved(vertices: Array, faces: Whole) -> tuple[Array, Whole, float, float]:
    """Return vertices (V, 3) [m] and triangles (F, 3) of a body with its curved surfaces.

    Facets at small angles to more than one neighbour are taken as those of a curved surface through
    their corners. Each becomes a cubic patch (Vlachos et al., Curved PN triangles, 2001), which
    lies on a sphere or cylinder to the fourth order of its size. Sharp edges between curved
    surfaces become curves, the same for both sides.

    Returns:
        Vertices and triangles; the largest distance of the surface from the facets [m], 0 if none
        is curved; and the largest angle between the facets of a curved surface [rad].
    """
    sides = _Sides(vertices, faces)
    smooth, bent = sides.smooth()
    if not bent.any():
        return vertices, faces, 0.0, 0.0
    normals = _corner_normals(vertices, faces, sides, smooth)
    control = _sides_control(vertices, faces, sides, smooth, normals)
    first = vertices[faces]
    along = np.roll(first, -1, axis=1) - first
    off = np.abs(control - np.stack([along / 3, -along / 3], axis=2)).max(axis=3).max(axis=2)
    bulge = 0.75 * float(off.max())
    curves = off.max(axis=1) > CLOSE
    if not curves.any():
        return vertices, faces, 0.0, 0.0
    parts = min(PARTS_MOST, max(2, math.ceil(math.sqrt(bulge / CLOSE))))
    points, triangles = _patches(first[curves], control[curves], parts)
    return (
        np.concatenate([vertices, points]),
        np.concatenate([faces[~curves], triangles + len(vertices)]),
        bulge,
        float(sides.angle[bent].max()),
    )


class _Sides:
    """Sides that two triangles share: the faces (S, 2), and the places of the side in each."""

    def __init__(self, vertices: Array, faces: Whole) -> None:
        corners = vertices[faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normal, axis=1)
        self.normal = normal / np.where(length > 0, length, 1.0)[:, None]
        self.area = length / 2
        start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
        low, high = np.minimum(start, end), np.maximum(start, end)
        order = np.lexsort((start, high, low))
        key = np.column_stack([low, high])[order]
        first = np.flatnonzero(np.append(True, (key[1:] != key[:-1]).any(axis=1)))
        pairs = first[np.diff(np.append(first, len(key))) == 2]
        # Half-sides are numbered 3 x face + corner; the first of a pair runs from `low` to `high`.
        self.half = np.stack([order[pairs], order[pairs + 1]], axis=1)
        self.face, self.corner = self.half // 3, self.half % 3
        one, other = self.face.T
        sine = np.linalg.norm(np.cross(self.normal[one], self.normal[other]), axis=1)
        cosine = np.einsum("ij,ij->i", self.normal[one], self.normal[other])
        self.angle = np.arctan2(sine, cosine)
        self.length = np.linalg.norm(
            vertices[low[self.half[:, 0]]] - vertices[high[self.half[:, 0]]], axis=1
        )

    def smooth(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return which sides (S,) are within a plane or a curved surface, and which are bent."""
        flat = self.angle < PLANE
        width = 2 * self.area[self.face].min(axis=1) / self.length
        bent = ~flat & (self.angle < BENT) & (self.angle / 8 * width < BULGE_MOST)
        count = len(self.area)
        facet = _joined(self.face[flat], count)
        this, other = np.concatenate([pairs := facet[self.face[bent]], pairs[:, ::-1]]).T
        angle, beyond = np.tile(self.angle[bent], 2), np.zeros(2 * len(pairs))
        if bent.any():
            beyond = _beyond(this, other, angle, count)
        beyond_other = np.roll(beyond, len(pairs))
        size = np.bincount(facet, self.area, count)
        rim, length = facet[self.face[~flat]].ravel(), np.repeat(self.length[~flat], 2)
        around = np.bincount(rim, length, count)
        breadth = size / np.where(around > 0, around, np.inf)
        larger = size[this] > LARGER * size[other]
        # A curved surface goes on beyond a facet at about the same angle, and at half of it into a
        # plane.
        smooth = np.maximum(beyond, beyond_other) > ALIKE * angle
        smooth &= ~(larger & (angle > SHARPER * beyond_other))
        smooth = np.tile(smooth.reshape(2, -1).all(axis=0), 2)
        bent[bent] = smooth[: len(pairs)]
        # A ring between curved surfaces is a plane by symmetry alone, and at the whole angle.
        ring = larger & (breadth[this] < BROADER * breadth[other])
        ring &= angle > HALVED * beyond_other
        ring = np.bincount(this, smooth & ~ring, count) == 0
        largest = np.zeros(count)
        np.maximum.at(largest, this[smooth], size[other[smooth]])
        self.size = np.where(ring, np.minimum(size, largest), size)[facet]
        return flat | bent, bent


def _beyond(this: Whole, other: Whole, angle: Array, count: int) -> Array:
    """Return the largest angle (N,) of each facet `this` to a neighbour that is not `other`."""
    pair, of = np.unique(this * count + other, return_inverse=True)
    step, owner = np.zeros(len(pair)), pair // count
    np.maximum.at(step, of, angle)
    order = np.lexsort((-step, owner))
    first = order[np.diff(owner[order], prepend=-1) > 0]
    most, second = np.zeros((2, count))
    most[owner[first]] = step[first]
    rest = np.setdiff1d(order, first)
    np.maximum.at(second, owner[rest], step[rest])
    is_first = np.isin(np.arange(len(pair)), first)
    return np.asarray(np.where(is_first, second[owner], most[owner])[of])


def _joined(pairs: Whole, count: int) -> Whole:
    """Return the number of the group (count,) of each thing, joined by pairs (N, 2)."""
    joins = coo_array((np.ones(len(pairs)), pairs.T), shape=(count, count))
    return np.asarray(connected_components(joins, directed=False)[1], np.int64)


def _corner_normals(
    vertices: Array, faces: Whole, sides: _Sides, smooth: NDArray[np.bool_]
) -> Array:
    """Return unit normals (F, 3, 3) of the surface at each triangle's corners.

    Triangles that meet smoothly at a corner have one normal there: that of a plane among them, or
    their mean, weighted so that it is exact on a sphere (Max, Weights for computing vertex normals
    from facet normals, 1999).
    """
    half, corner = sides.half[smooth], sides.corner[smooth]
    after = half - corner + (corner + 1) % 3
    # The sides run in opposite directions: where one begins, the other ends.
    ends = np.concatenate(
        [np.stack([half[:, 0], after[:, 1]], 1), np.stack([after[:, 0], half[:, 1]], 1)]
    )
    group = _joined(ends, faces.size)
    at = vertices[faces]
    ahead, behind = np.roll(at, -1, axis=1) - at, np.roll(at, 1, axis=1) - at
    lengths = (ahead**2).sum(axis=2) * (behind**2).sum(axis=2)
    weight = 2 * sides.area[:, None] / np.where(lengths > 0, lengths, np.inf)
    size = np.repeat(sides.size, 3)
    largest = np.zeros(faces.size)
    np.maximum.at(largest, group, size)
    weight = np.where(size * LARGER >= largest[group], weight.ravel(), 0.0)
    normal = np.repeat(sides.normal, 3, axis=0) * weight[:, None]
    total: Array = np.stack(
        [np.bincount(group, normal[:, i], faces.size) for i in range(3)], axis=1
    )
    length = np.linalg.norm(total, axis=1)
    total = total / np.where(length > 0, length, 1.0)[:, None]
    return total[group].reshape(-1, 3, 3)


def _sides_control(
    vertices: Array, faces: Whole, sides: _Sides, smooth: NDArray[np.bool_], normals: Array
) -> Array:
    """Return the two control points of each triangle's sides, from their ends (F, 3, 2, 3) [m]."""
    at = vertices[faces]
    along = np.roll(at, -1, axis=1) - at
    control = np.stack([along, -along], axis=2).reshape(-1, 2, 3) / 3
    normal = normals.reshape(-1, 3)
    one, other = sides.half.T
    after = sides.half - sides.corner + (sides.corner + 1) % 3
    for end, mine, its in ((0, one, after[:, 1]), (1, after[:, 0], other)):
        way = control[one, end]
        here, there = normal[mine], normal[its]
        off = np.einsum("ij,ij->i", way, here)[:, None] * here
        edge = np.cross(here, there)
        square = np.einsum("ij,ij->i", edge, edge)
        along_edge = np.einsum("ij,ij->i", way, edge) / np.where(square > 0, square, 1.0)
        tangent = np.where(smooth[:, None], way - off, along_edge[:, None] * edge)
        far = np.linalg.norm(tangent - way, axis=1) > ASIDE * np.linalg.norm(way, axis=1)
        tangent[far] = way[far]
        control[one, end] = control[other, 1 - end] = tangent
    return control.reshape(-1, 3, 2, 3)


def _patches(first: Array, control: Array, parts: int) -> tuple[Array, Whole]:
    """Return points and triangles of cubic patches (P, 3, 3), each side cut in `parts`."""
    ahead = first + control[:, :, 0]
    back = np.roll(first, -1, axis=1) + control[:, :, 1]
    middle = (ahead + back).sum(axis=1) / 6
    middle += (middle - first.mean(axis=1)) / 2
    steps = [(i, j) for i in range(parts + 1) for j in range(parts + 1 - i)]
    number = {step: index for index, step in enumerate(steps)}
    v, w = np.array(steps).T / parts
    weight = [1 - v - w, v, w]
    points = 6 * (weight[0] * weight[1] * weight[2])[:, None] * middle[:, None]
    for i in range(3):
        here, there = weight[i], weight[(i + 1) % 3]
        points = points + (here**3)[:, None] * first[:, i, None]
        points += (3 * here * here * there)[:, None] * ahead[:, i, None]
        points += (3 * here * there * there)[:, None] * back[:, i, None]
    cells = []
    for i, j in steps:
        if i + j < parts:
            cells.append((number[i, j], number[i + 1, j], number[i, j + 1]))
        if i + j < parts - 1:
            cells.append((number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]))
    start = np.arange(len(first))[:, None, None] * len(steps)
    return points.reshape(-1, 3), (start + np.array(cells)).reshape(-1, 3)
