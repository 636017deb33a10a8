"""Mesh: a grid of 8-node hexahedra from the bonded base to the top of a body.

Elements are finest in a window in plan around the contacts, and grow outwards from there.

Lengths are in units of the body's thickness. Nodes are numbered with z running fastest, then y,
then x; the 8 corners of an element likewise, from (0, 0, 0) to (1, 1, 1).
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

from sim.arrays import Array
from sim.errors import SceneError
from sim.fem import CELLS_MAX, ELEMENTS_DEFAULT, Fem, Grading
from sim.fem.sizing import (
    DEEPEST,
    GROWTH,
    GROWTH_DOWN,
    SQUEEZE_ERROR,
    Sizes,
    Span,
    extent_of,
    places_of,
    squeeze,
    stages_of,
)
from sim.indenters import Indenter
from sim.scene import Body, Scene

# Steps along x, y, z to each corner of a cell, by its index.
CORNERS = tuple((i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1))
# Abscissa of the 2-point Gauss rule on -1 to 1.
GAUSS = 1 / np.sqrt(3)

# Numbers of elements along x and y are a multiple of this, above `MANY` of twice this, so that many
# presses share a topology.
MULTIPLE, MANY = 4, 24
# Fraction of a column of elements within the footprint below which the column is dropped: such
# slivers give their nodes next to no stiffness.
SHARE_LEAST = 0.1
# Exponent of the vertical grading: elements are flatter towards the top, where the strain is.
GRADING = 1.25
Window = tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True, slots=True)
class Mesh:
    """Nodes, elements and contact faces of one body; E elements, N nodes, S faces."""

    cells: tuple[int, int, int]
    """Elements along x, y, z."""
    x: NDArray[np.float64]
    """Node positions along x (X,), in thicknesses."""
    y: NDArray[np.float64]
    """The same along y (Y,)."""
    fineness: float
    """Fineness as in `Fem`, if the mesh follows the contact; else NaN."""
    nodes: NDArray[np.float64]
    """Rest positions (N, 3), in thicknesses."""
    elements: NDArray[np.int32]
    """Node of each corner (E, 8)."""
    inverse: NDArray[np.float64]
    """d(reference coordinates)/d(position) at the 8 Gauss points (E, 8, 3, 3)."""
    weight: NDArray[np.float64]
    """Volume of each Gauss point (E, 8)."""
    faces: NDArray[np.int32]
    """Nodes of the corners (S, 4) of every face that can be touched: the top, then the sides."""
    face_area: NDArray[np.float64]
    """Rest area of each face over the area 4 of the reference square (S,)."""
    node_elements: NDArray[np.int32]
    """Element and corner, 8 e + a, around each node (N, 8); -1 where there is none."""
    node_faces: NDArray[np.int32]
    """Face and corner, 4 s + a, around each node (N, 4); -1 where there is none."""
    free: NDArray[np.bool_]
    """True for nodes that move (N,): all but those on the base."""
    node_volume: NDArray[np.float64]
    """Volume lumped to each node (N,)."""
    finest: float
    """Side of the smallest element in plan, in thicknesses."""
    topmost: float
    """Height of the topmost elements, in thicknesses."""
    top: NDArray[np.int64]
    """Node numbers of the top (X, Y)."""
    top_area: Array
    """Area of the nodes of the top (X, Y); inf outside a round body."""
    fraction: NDArray[np.float64] | None = None
    """Fraction of each column of elements within a round footprint (X - 1, Y - 1), which weights
    its elements; 0 means no elements. None: all columns are whole."""

    @property
    def inert_volume(self) -> Array:
        """Volume for inertia, lumped to the nodes (N,): that of the top is given to those below it.

        Where nodes without mass touch, the force of an impact does not ring (Khenous, Laborde &
        Renard, European Journal of Mechanics A 27, 2008).
        """
        columns = self.node_volume.reshape(-1, self.cells[2] + 1).copy()
        columns[:, -2] += columns[:, -1]
        columns[:, -1] = 0.0
        return columns.ravel()

    @property
    def beside(self) -> NDArray[np.bool_]:
        """True for columns of nodes that belong to no element (X, Y)."""
        if self.fraction is None:
            return np.zeros((len(self.x), len(self.y)), dtype=bool)
        empty = np.pad(self.fraction == 0, 1, constant_values=True)
        return np.asarray(empty[1:, 1:] & empty[:-1, 1:] & empty[1:, :-1] & empty[:-1, :-1])


def cell_counts(body: Body, spacing: float) -> tuple[int, int, int]:
    """Return the numbers of elements of about `spacing` [m] along x, y, z."""
    sizes = (body.size_x, body.size_y, body.thickness)
    if not (np.isfinite(spacing) and spacing > 0):
        raise SceneError(f"mesh: {spacing!r} m; allowed: above 0")
    counts = tuple(max(1, round(size / spacing)) for size in sizes)
    if counts[2] < 3 or min(counts[:2]) < 4:
        coarsest = min(body.thickness / 3, body.size_x / 4, body.size_y / 4)
        raise SceneError(
            f"mesh: elements of {spacing * 1e3:.4g} mm; allowed: up to {coarsest * 1e3:.4g} mm "
            "for this body (3 through the thickness, 4 across)"
        )
    if counts[0] * counts[1] * counts[2] > CELLS_MAX:
        raise SceneError(
            f"mesh: {spacing * 1e3:.4g} mm makes {counts[0]}x{counts[1]}x{counts[2]} elements; "
            f"allowed: up to {CELLS_MAX} in all"
        )
    return counts[0], counts[1], counts[2]


def axis(
    size: float,
    spacing: float,
    window: tuple[float, float],
    coarsest: float,
    growth: float,
    *,
    at_least: int = 0,
) -> Array:
    """Return node positions from -size/2 to size/2: `spacing` or less in the window, then growing.

    All lengths are in one unit; `growth` and `coarsest` are those of a `Grading`. The number of
    elements is a multiple, see `MULTIPLE`, or `at_least`.
    """
    position = np.linspace(-size / 2, size / 2, 2001)
    away = np.maximum(np.maximum(window[0] - position, position - window[1]), 0.0)
    density = 1.0 / np.minimum(spacing + growth * away, max(coarsest, spacing))
    count = np.asarray(cumulative_trapezoid(density, position, initial=0.0))
    return _in_buckets(count, position, at_least=at_least)


def axes(
    body: Body,
    spacing: float,
    window: Window | None = None,
    grading: Grading | None = None,
    *,
    at_least: tuple[int, int] = (0, 0),
) -> tuple[Array, Array]:
    """Return the node positions of `build_mesh` along x (X,) and y (Y,), in thicknesses.

    `spacing` [m] is the height of the elements, and except for grading their side in the window ((x
    least, x most), (y least, y most)) [m]; outside they grow. Without a window all are equal; with
    one `at_least` are their least numbers along x and y.
    """
    nx, ny, _nz = cell_counts(body, spacing)
    unit = body.thickness
    sizes = (body.size_x, body.size_y)
    if window is None:
        x, y = (
            np.linspace(-size / 2, size / 2, count + 1) / unit
            for size, count in zip(sizes, (nx, ny), strict=True)
        )
    else:
        grading = grading or Grading()
        finest, coarsest = grading.finer * spacing, grading.coarsest * unit
        x, y = (
            axis(size, finest, sides, coarsest, grading.growth, at_least=least) / unit
            for size, sides, least in zip(sizes, window, at_least, strict=True)
        )
    return x, y


def build_mesh(
    body: Body,
    spacing: float,
    window: Window | None = None,
    grading: Grading | None = None,
    *,
    at_least: tuple[int, int] = (0, 0),
) -> Mesh:
    """Return the mesh of a body with elements of about `spacing` [m]; arguments as in `axes`."""
    x, y = axes(body, spacing, window, grading, at_least=at_least)
    layers = cell_counts(body, spacing)[2]
    return _mesh(body, x, y, 1.0 - np.linspace(1.0, 0.0, layers + 1) ** GRADING)


def _mesh(body: Body, x: Array, y: Array, fraction: Array, fineness: float = np.nan) -> Mesh:
    """Return the mesh with nodes at x (X,), y (Y,) [thicknesses] and z (Z,) [height]."""
    unit = body.thickness
    cells = len(x) - 1, len(y) - 1, len(fraction) - 1
    height = body.heights(x * unit, y * unit) / unit
    positions = np.empty((len(x), len(y), len(fraction), 3))
    positions[..., 0] = x[:, None, None]
    positions[..., 1] = y[None, :, None]
    positions[..., 2] = -1.0 + (1.0 + height[:, :, None]) * fraction
    nodes = positions.reshape(-1, 3)
    grid = _topology(cells)
    if height.any():
        inverse, weight = _geometry(nodes[grid["elements"]])
        volume = _node_volumes(grid["elements"], weight, len(nodes))
        area = _face_areas(nodes[grid["faces"]])
    else:
        sides = np.diff(x), np.diff(y), np.diff(fraction)
        inverse, weight, volume, area = _of_boxes(*sides)
    inside = None
    if body.footprint != "rectangle":
        inside = body.fractions(x * unit, y * unit)
        inside[inside < SHARE_LEAST] = 0.0
        weight = weight * np.repeat(inside.ravel(), cells[2])[:, None]
        volume = _node_volumes(grid["elements"], weight, len(nodes))
        # The sides of the grid lie outside the body.
        area = np.concatenate([area[: inside.size] * inside.ravel(), 0 * area[inside.size :]])
    top = grid["top"]
    column = top[0, 0] if inside is None else top[cells[0] // 2, cells[1] // 2]
    return Mesh(
        cells=cells,
        x=x,
        y=y,
        fineness=fineness,
        nodes=nodes,
        inverse=inverse,
        weight=weight,
        face_area=area,
        node_volume=volume,
        finest=_finest(x, y),
        topmost=float(nodes[column, 2] - nodes[column - 1, 2]),
        top_area=_top_area(grid["faces"], area, cells),
        fraction=inside,
        **grid,
    )


@functools.lru_cache(maxsize=16)
def _topology(cells: tuple[int, int, int]) -> dict[str, NDArray[Any]]:
    """Return the parts of `Mesh` that meshes with the same cell counts share, by name."""
    nx, ny, nz = cells
    count = (nx + 1) * (ny + 1) * (nz + 1)
    grid = np.arange(count, dtype=np.int32).reshape(nx + 1, ny + 1, nz + 1)
    elements = np.stack(
        [grid[i : nx + i, j : ny + j, k : nz + k].ravel() for i, j, k in CORNERS], axis=1
    )
    faces = _faces(grid)
    free = np.ones(count, dtype=bool)
    free[grid[:, :, 0].ravel()] = False
    return {
        "elements": elements,
        "faces": faces,
        "node_elements": _around(elements, count, 8),
        "node_faces": _around(faces, count, 4),
        "free": free,
        "top": grid[:, :, -1].astype(np.int64),
    }


def _geometry(corners: Array) -> tuple[Array, Array]:
    """Return inverse Jacobians (E, 8, 3, 3) and volumes (E, 8) at the Gauss points of (E, 8, 3)."""
    signs = 2.0 * np.array(CORNERS) - 1.0
    inverse = np.empty((len(corners), 8, 3, 3))
    weight = np.empty((len(corners), 8))
    by_corner = np.ascontiguousarray(corners.transpose(1, 2, 0)).reshape(8, -1)
    for point, local in enumerate(signs * GAUSS):
        factors = 1.0 + signs * local
        gradient = np.empty((8, 3))
        for axis in range(3):
            others = [other for other in range(3) if other != axis]
            gradient[:, axis] = signs[:, axis] * factors[:, others].prod(1) / 8
        a, b, c = (gradient.T @ by_corner).reshape(3, 3, -1).transpose(0, 2, 1)
        # Columns of the Jacobian; the rows of its inverse are their cross products over det.
        rows = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)], axis=1)
        weight[:, point] = (a * rows[:, 0]).sum(1)
        inverse[:, point] = rows / weight[:, point, None, None]
    return inverse, weight


def _of_boxes(x: Array, y: Array, z: Array) -> tuple[Array, Array, Array, Array]:
    """Both of `_geometry`, `_node_volumes`, `_face_areas` for boxes of sides (X,), (Y,), (Z,)."""
    sides = np.broadcast_arrays(x[:, None, None], y[:, None], z)
    inverse = np.zeros((*sides[0].shape, 3, 3))
    for axis, side in enumerate(sides):
        inverse[..., axis, axis] = 2.0 / side
    weight = (sides[0] * sides[1] * sides[2] / 8).reshape(-1, 1)
    inverse = np.broadcast_to(inverse.reshape(-1, 1, 3, 3), (len(weight), 8, 3, 3))
    u, v, w = (np.concatenate([[0.0], side / 2]) + np.append(side / 2, 0.0) for side in (x, y, z))
    volume = (u[:, None, None] * v[:, None] * w).ravel()
    sheets = ((x, y), (y, z), (y, z), (x, z), (x, z))
    area = np.concatenate([np.outer(one, other).ravel() / 4 for one, other in sheets])
    return inverse, np.broadcast_to(weight, (len(weight), 8)), volume, area


def _node_volumes(elements: NDArray[np.int32], weight: Array, count: int) -> Array:
    """Return an eighth of the volume (E, 8) of the elements (E, 8) around each node (N,)."""
    eighth = np.repeat(weight.sum(1, keepdims=True) / 8, 8, axis=1)
    return np.asarray(np.bincount(elements.ravel(), eighth.ravel(), count), np.float64)


def _cross(a: Array, b: Array) -> Array:
    """Return cross products of vectors (E, 3), several times as fast as NumPy's."""
    x, y, z = a.T
    u, v, w = b.T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)


def _faces(grid: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the faces of the top and the four sides, corners (0,0) (0,1) (1,0) (1,1)."""
    sheets = (grid[:, :, -1], grid[0], grid[-1], grid[:, 0], grid[:, -1])
    faces = [
        np.stack([sheet[:-1, :-1], sheet[:-1, 1:], sheet[1:, :-1], sheet[1:, 1:]], axis=-1)
        for sheet in sheets
    ]
    return np.concatenate([face.reshape(-1, 4) for face in faces])


def _face_areas(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a quarter of the area of each face (S,), as two triangles."""
    one = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    two = np.cross(corners[:, 1] - corners[:, 3], corners[:, 2] - corners[:, 3])
    area: NDArray[np.float64] = np.linalg.norm(one, axis=1) + np.linalg.norm(two, axis=1)
    return area / 8


def _top_area(faces: NDArray[np.int32], area: Array, cells: tuple[int, int, int]) -> Array:
    """Return the area of each node of the top (X, Y), from that of the faces (S,)."""
    nx, ny, nz = cells
    corners, each = faces[: nx * ny] // (nz + 1), np.repeat(area[: nx * ny], 4)
    nodal = np.bincount(corners.ravel(), each, (nx + 1) * (ny + 1))
    return np.where(nodal > 0, nodal, np.inf).reshape(nx + 1, ny + 1)


def _around(cells: NDArray[np.int32], count: int, most: int) -> NDArray[np.int32]:
    """Return the cells around each of `count` nodes as `cell * corners + corner`, -1 filled."""
    corners = cells.shape[1]
    order = np.argsort(cells.ravel(), kind="stable")
    node = cells.ravel()[order]
    slot = np.arange(len(node)) - np.searchsorted(node, node)
    around = np.full((count, most), -1, dtype=np.int32)
    around[node, slot] = order
    if corners * len(cells) > np.iinfo(np.int32).max:
        raise SceneError(f"mesh: {len(cells)} cells; allowed: up to {2**31 // corners}")
    return around


# Meshes that follow the contacts of scenes.

# Longest element, in thicknesses, if all of a body moves: under gravity, inertia, or unpressed.
LONGEST_EVEN = 1 / 4
# Allowed height of a dome above the flat faces of its elements, in thicknesses.
DOME_SHARE = 0.01
# Least fineness to which the limit on the number of elements may lead.
COARSEST_FINENESS = 0.1


def following_mesh(
    scene: Scene,
    sizes: Sizes,
    fineness: float,
    elements_max: int,
    at_least: tuple[int, int] = (0, 0),
) -> Mesh:
    """Return the mesh as fine as `sizes` times `fineness`, or coarser if it has too many elements.

    `at_least` is the least numbers of elements along x and y.
    """
    return _mesh(scene.body, *_following_axes(scene, sizes, fineness, elements_max, at_least))


def outline_of(scene: Scene, numerics: Fem, sizes: Sizes | None = None) -> tuple[int, float, float]:
    """Return `len(nodes)`, `finest` and `fineness` of such a mesh; sizes as in `meshes_of`."""
    sizes = stages_of(scene)[0].sizes if sizes is None else sizes
    most = numerics.elements_max or ELEMENTS_DEFAULT["cpu"]
    x, y, fraction, fineness = _following_axes(scene, sizes, numerics.fineness, most)
    return len(x) * len(y) * len(fraction), _finest(x, y), fineness


def _finest(x: Array, y: Array) -> float:
    return float(max(np.diff(x).min(), np.diff(y).min()))


def _following_axes(
    scene: Scene,
    sizes: Sizes,
    fineness: float,
    elements_max: int,
    at_least: tuple[int, int] = (0, 0),
) -> tuple[Array, Array, Array, float]:
    """Return the arguments of `_mesh` for `following_mesh`."""
    body, unit = scene.body, scene.body.thickness
    effects = scene.effects
    whole = effects.gravity is not None or effects.inertia is not None or not sizes.x
    longest = LONGEST_EVEN * unit if whole else max(body.size_x, body.size_y)
    if body.dome_radius is not None:
        longest = min(longest, float(np.sqrt(8 * body.dome_radius * DOME_SHARE * unit)))
    top = min(sizes.top, (LONGEST_EVEN if whole else DEEPEST) * unit)
    squeezed = float(np.sqrt(squeeze(scene, sizes.width) / SQUEEZE_ERROR))
    while True:
        along = [
            places_of(spans, -side / 2, side / 2, growth=GROWTH, longest=longest, fineness=fineness)
            for spans, side in ((sizes.x, body.size_x), (sizes.y, body.size_y))
        ]
        down = places_of(
            [Span(0.0, 0.0, top)],
            0.0,
            unit,
            growth=GROWTH_DOWN,
            longest=DEEPEST * unit,
            fineness=fineness,
        )
        x, y = (
            _in_buckets(*counted, at_least=least)
            for counted, least in zip(along, at_least, strict=True)
        )
        layers = max(3, int(np.ceil(max(down[0][-1], fineness * squeezed))))
        layers += layers % 2 if layers > MANY_LAYERS else 0
        if (len(x) - 1) * (len(y) - 1) * layers <= elements_max or fineness <= COARSEST_FINENESS:
            break
        fineness *= 0.95
    depth = np.interp(np.linspace(0.0, down[0][-1], layers + 1), *down)
    return x / unit, y / unit, 1.0 - depth[::-1] / unit, fineness


# Number of layers of elements above which it is rounded up to an even number.
MANY_LAYERS = 8


def _in_buckets(counted: Array, place: Array, *, at_least: int) -> Array:
    """Return node positions with a multiple of elements between them, as described in `axis`."""
    multiple = MULTIPLE if counted[-1] <= MANY else 2 * MULTIPLE
    cells = max(at_least, multiple * max(1, int(np.ceil(counted[-1] / multiple - 1e-6))))
    return np.asarray(np.interp(np.linspace(0.0, counted[-1], cells + 1), counted, place))


# Window in plan that the indenter reaches: the part of a body that is meshed finely.

# Width of the finely meshed rim around the footprint, in fine elements.
MARGIN = 1.0


def meshes_of(
    scenes: Sequence[Scene], numerics: Fem, sizes: Sequence[Sizes] | None = None
) -> list[Mesh]:
    """Return the meshes for scenes; `Fem.one_topology` makes their element counts agree.

    `sizes` are those that the contacts of each scene require, if the mesh follows them; without
    them they are estimated here.
    """
    if sizes is None and numerics.follows:
        sizes = [stages_of(scene)[0].sizes for scene in scenes]
    if sizes is not None:
        settings = [
            (scene, size, numerics.fineness, numerics.elements_max or ELEMENTS_DEFAULT["cpu"])
            for scene, size in zip(scenes, sizes, strict=True)
        ]
        meshes = [following_mesh(*each) for each in settings]
        if numerics.one_topology:
            most = max(m.cells[0] for m in meshes), max(m.cells[1] for m in meshes)
            meshes = [following_mesh(*each, most) for each in settings]
        return meshes
    plans: list[tuple[Body, float, Window, Grading | None]] = []
    for scene in scenes:
        spacing = numerics.height(scene.body)
        window = contact_window(scene, MARGIN * spacing)
        plans.append((scene.body, spacing, window, numerics.grading))
    most = 0, 0
    if numerics.one_topology:
        counts = [[len(nodes) - 1 for nodes in axes(*plan)] for plan in plans]
        most = max(x for x, _y in counts), max(y for _x, y in counts)
    return [build_mesh(*plan, at_least=most) for plan in plans]


def contact_window(scene: Scene, margin: float) -> Window:
    """Return a box in plan around the undeformed top that the indenter covers, and `margin` [m]."""
    tip = np.asarray(scene.motion.tip)
    half = np.array([scene.body.size_x, scene.body.size_y]) / 2
    depth = max(-float(tip[:, 2].min()), 0.0)
    reach = float(2 * half.max() + np.abs(tip[:, :2]).max())
    low, high = _footprint(scene.indenter, depth, _sides(scene.indenter, depth, reach))
    low = np.clip(tip[:, :2].min(0) + low - margin, -half, half)
    high = np.clip(tip[:, :2].max(0) + high + margin, -half, half)
    return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))


@functools.lru_cache(maxsize=1024)
def _sides(indenter: Indenter, depth: float, reach: float) -> Window:
    """Return a box in plan around an indenter's lowest `depth`, up to `reach` from the tip [m]."""
    x, y = np.clip(indenter.bounds_below(depth)[:2], -reach, reach).tolist()
    return tuple(x), tuple(y)


@functools.lru_cache(maxsize=1024)
def _footprint(indenter: Indenter, depth: float, sides: Window) -> tuple[Array, Array]:
    """Return least and greatest (x, y) [m] of an indenter's lowest `depth`, inside a box."""
    low, high = np.transpose(sides)

    def outside(x: Array, y: Array, level: float, columns: NDArray[np.bool_]) -> Array:
        at_x, at_y = (at[columns] for at in np.meshgrid(x, y, indexing="ij"))
        points = np.stack([at_x, at_y, np.full(len(at_x), level * depth)], axis=1)
        return np.asarray(indenter.distance(points)[0])

    return extent_of(outside, low, high) or (np.zeros(2), np.zeros(2))
