"""Overlap of the skin with itself: measured where the surface folds, and not prevented.

Skin can only meet skin where some of it has turned by a right angle or more. Around faces that have
turned nearly as far, each surface node is tested against all elements that do not have it as a
corner. A node inside one has passed through the skin there. Its depth is its distance from the skin
above, or to the side of, the same material point of that element.

Lengths in thicknesses. It runs on the host in a few milliseconds, if a face has folded, and beside
a GPU only if `sim.fem.crossing.Crossing` has found a node to look at.
"""

import math

import numpy as np
from numpy.typing import NDArray

from sim.arrays import Array
from sim.fem.contact import FOLDED
from sim.fem.mesh import CORNERS, Mesh

Indices = NDArray[np.int64]

# Newton iterations to locate a point in an element; near its middle 3 or 4 are enough.
NEWTON = 12
# Last Newton step of a point that is located, in reference coordinates.
LOCATED = 1e-10
# Most strips in which nodes near a fold are sorted.
STRIPS_MOST = 256
# Overlaps below this are rounding.
ON_SKIN = 1e-6
SIGNS = 2.0 * np.array(CORNERS) - 1.0
# Corners of the six sides of an element, each way around (4, 6).
SIDES = np.array(
    [
        sorted(
            np.flatnonzero(SIGNS[:, axis] == sign).tolist(),
            key=lambda one: math.atan2(SIGNS[one, axis - 1], SIGNS[one, axis - 2]),
        )
        for axis in range(3)
        for sign in (-1.0, 1.0)
    ]
).T


def folded_faces(mesh: Mesh, places: Array) -> NDArray[np.bool_]:
    """True for faces (S,) of the body turned by more than 80 degrees; nodes at `places` (N, 3)."""
    rest, now = _normals(mesh.nodes, mesh.faces), _normals(places, mesh.faces)
    along = _dot(rest, now)
    least = FOLDED**2 * _dot(rest, rest) * _dot(now, now)
    return np.asarray(((along < 0) | (along * along < least)) & (mesh.face_area > 0))


def self_overlap(mesh: Mesh, u: Array) -> tuple[float, int]:
    """Return the depth of the skin inside itself, displaced by `u` (N, 3), and its deepest node.

    0 and -1 if it does not overlap.
    """
    positions = mesh.nodes + u
    folded = folded_faces(mesh, positions)
    if not folded.any():
        return 0.0, -1
    node, element = _pairs(mesh, positions, *_near(mesh, positions, mesh.faces[folded]))
    may_be = _may_be_within(positions[mesh.elements[element]], positions[node])
    node, element = node[may_be], element[may_be]
    local = _within(positions[mesh.elements[element]], positions[node])
    inside = (np.abs(local) <= 1.0).all(axis=1)  # NaN is not
    if not inside.any():
        return 0.0, -1
    node, element, local = node[inside], element[inside], local[inside]
    depth = _depths(mesh, positions, element, local, positions[node])
    deepest = int(np.argmax(depth))
    return (float(depth[deepest]), int(node[deepest])) if depth[deepest] > ON_SKIN else (0.0, -1)


def _normals(places: Array, faces: NDArray[np.int32]) -> Array:
    """Return normals (3, S) of faces from their diagonals, on the same side before and after."""
    corner = places.T[:, faces.T]
    x, y, z = corner[:, 3] - corner[:, 0]
    u, v, w = corner[:, 2] - corner[:, 1]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u])


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _near(
    mesh: Mesh, places: Array, folded: NDArray[np.int32]
) -> tuple[NDArray[np.bool_], Indices, Array, Array]:
    """Return masks of surface nodes (N,), and elements (E,), in a box around folded faces (T, 4).

    Also the least and greatest corners of the elements' own boxes (E, 3).
    """
    corner = places[folded]
    longest = float(np.ptp(corner, axis=1).max())
    low, high = corner.min(axis=(0, 1)) - longest, corner.max(axis=(0, 1)) + longest
    at_skin = np.zeros(len(places), bool)
    at_skin[mesh.faces[mesh.face_area > 0]] = True
    here = at_skin & ((places >= low) & (places <= high)).all(axis=1)
    cells = np.array(mesh.cells)
    least = most = places.reshape(*(cells + 1), 3)
    for axis in range(3):
        before = (slice(None),) * axis
        first, second = (*before, slice(-1)), (*before, slice(1, None))
        least = np.minimum(least[first], least[second])
        most = np.maximum(most[first], most[second])
    reaches = ((most >= low) & (least <= high)).all(axis=-1)
    if mesh.fraction is not None:  # elements outside a round body are no material
        reaches &= mesh.fraction[:, :, None] > 0
    return here, np.flatnonzero(reaches), least[reaches], most[reaches]


def _pairs(
    mesh: Mesh, places: Array, here: NDArray[np.bool_], elements: Indices, low: Array, high: Array
) -> tuple[Indices, Indices]:
    """Return nodes and elements (P,) with the node in the element's box, but not its corner."""
    nodes = np.flatnonzero(here)
    if not len(nodes):
        return nodes, nodes
    # Nodes in strips along x, as wide as most elements, and by y in each. The strips' keys follow
    # each other, so that an element's box holds a range of keys in each strip that it reaches.
    strip = max(np.median(high[:, 0] - low[:, 0]), np.ptp(places[nodes, 0]) / STRIPS_MOST)
    bottom = min(low[:, 1].min(), places[nodes, 1].min())
    apiece = 2 * (max(high[:, 1].max(), places[nodes, 1].max()) - bottom)
    key = np.floor(places[nodes, 0] / strip) * apiece + places[nodes, 1] - bottom
    nodes, key = nodes[order := np.argsort(key)], key[order]
    begin = np.floor(low[:, 0] / strip)
    reached = (np.floor(high[:, 0] / strip) - begin).astype(int) + 1
    row = np.repeat(np.arange(len(elements)), reached)
    keys = (begin[row] + _counted(reached)) * apiece - bottom
    first = np.searchsorted(key, keys + low[row, 1], "left")
    count = np.searchsorted(key, keys + high[row, 1], "right") - first
    row, node = np.repeat(row, count), np.repeat(first, count) + _counted(count)
    for axis in range(3):
        at = places[nodes[node], axis]
        within = (at >= low[row, axis]) & (at <= high[row, axis])
        row, node = row[within], node[within]
    apart = (mesh.elements[elements[row]] != nodes[node][:, None]).all(axis=1)
    return nodes[node[apart]], elements[row[apart]]


def _counted(counts: Indices) -> Indices:
    """Return 0, 1, ... up to each of the counts, one after the other (sum of the counts,)."""
    return np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)


def _may_be_within(corners: Array, points: Array) -> NDArray[np.bool_]:
    """False for points (P, 3) that lie outside of elements (P, 8, 3), for nearly all of those.

    An element is within the convex hull of its corners, so it is on one side of any plane that its
    corners are on one side of. The planes are parallel to the diagonals of one of its sides.
    """
    first, second, third, fourth = (corners[:, each] for each in SIDES)
    normal = np.cross(third - first, fourth - second)
    height = np.einsum("pai,pci->pac", normal, corners)
    at = np.einsum("pai,pi->pa", normal, points)
    rounding = 1e-9 * np.abs(height).max(axis=2)
    above, below = height.max(axis=2) + rounding, height.min(axis=2) - rounding
    return np.asarray(((at <= above) & (at >= below)).all(axis=1))


def _within(corners: Array, points: Array) -> Array:
    """Return reference coordinates (P, 3) of points (P, 3) in elements (P, 8, 3); NaN if none."""
    local = np.zeros(points.shape)
    size = np.ptp(corners, axis=1).max(axis=1)
    going = np.arange(len(points))
    for _ in range(NEWTON):
        corner, at = corners[going], local[going]
        x, y, z = np.moveaxis(1.0 + SIGNS * at[:, None], -1, 0)
        away = np.einsum("pc,pci->pi", x * y * z / 8, corner) - points[going]
        slopes = np.stack([SIGNS[:, 0] * y * z, SIGNS[:, 1] * x * z, SIGNS[:, 2] * x * y]) / 8
        jacobian = np.einsum("apc,pci->pia", slopes, corner)
        good = np.abs(np.linalg.det(jacobian)) > 1e-9 * size[going] ** 3
        jacobian[~good] = np.eye(3)
        step = np.linalg.solve(jacobian, away[:, :, None])[:, :, 0]
        local[going] = np.where(good[:, None], np.clip(at - step, -2.0, 2.0), np.nan)
        going = going[good & (np.abs(step) > LOCATED).any(axis=1)]
        if not len(going):
            break
    shape = (1.0 + SIGNS * local[:, None]).prod(axis=2) / 8
    left = np.linalg.norm(np.einsum("pc,pci->pi", shape, corners) - points, axis=1)
    return np.where((left < 1e-6 * size)[:, None], local, np.nan)


def _depths(mesh: Mesh, places: Array, element: Indices, local: Array, points: Array) -> Array:
    """Return distances (P,) of points in elements to the skin above or beside the same material."""
    cells = np.array(mesh.cells)
    grid = places.reshape(*(cells + 1), 3)
    first = np.stack(np.unravel_index(element, mesh.cells), axis=1)
    fraction = (local + 1) / 2
    depth = np.full(len(points), np.inf)
    for axis, at in ((2, cells[2]), (0, 0), (0, cells[0]), (1, 0), (1, cells[1])):
        sheet = np.take(grid, at, axis=axis)
        one, other = (each for each in range(3) if each != axis)
        i, j, a, b = first[:, one], first[:, other], fraction[:, [one]], fraction[:, [other]]
        skin = (sheet[i, j] * (1 - b) + sheet[i, j + 1] * b) * (1 - a)
        skin += (sheet[i + 1, j] * (1 - b) + sheet[i + 1, j + 1] * b) * a
        depth = np.minimum(depth, np.linalg.norm(skin - points, axis=1))
    return depth
