"""Bodies from STL files: reading, checks, orientation, and the signed distance to them."""

from __future__ import annotations

import hashlib
import io
import math
import re
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from sim.arrays import Array
from sim.errors import SceneError, check_choice, check_range
from sim.indenters.curved import curved
from sim.indenters.grid import SKIP, NodeGrid
from sim.indenters.outline import Bounds
from sim.indenters.rounding import RADII, Surface

if TYPE_CHECKING:
    from trimesh import Trimesh

    from sim.indenters.nearest import Nearest


# Signed distance on a grid, interpolated by tricubic B-splines.

# Gradients shorter than this have no direction.
FLAT = 1e-6
# Points evaluated together, so that their data stay in the processor's cache.
AT_ONCE = 1 << 18


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """Distance as a spline, twice differentiable, so that its normal varies smoothly.

    Beyond the sides and below the grid, the distance is extrapolated along the gradient at the
    border; above the grid, the body continues straight up.
    """

    grid: NodeGrid
    coefficients: Array
    """Coefficients of the B-splines, one per node (grid.shape) [m]."""
    drop: float
    """Distance by which the body is lower than on the grid [m]."""
    bounds: Bounds
    """Bounding box of the body [m]."""
    notes: tuple[str, ...] = ()
    """Remarks on changes to the body by rounding."""

    def distance(self, points: Array) -> tuple[Array, Array]:
        """Return gap (N,) [m] and unit normal (N, 3) at points (N, 3) [m]."""
        gap, normal = np.empty(len(points)), np.empty((len(points), 3))
        for first in range(0, len(points), AT_ONCE):
            some = slice(first, first + AT_ONCE)
            gap[some], normal[some] = self._distance(points[some])
        return gap, normal

    @property
    def origin(self) -> Array:
        """Position of the first node (3,) [m]."""
        return np.array(self.grid.first) * self.grid.spacing - [0.0, 0.0, self.drop]

    def _distance(self, points: Array) -> tuple[Array, Array]:
        spacing = self.grid.spacing
        position = (points - self.origin) / spacing
        held = np.clip(position, 1.0, np.array(self.grid.shape) - 3.0)
        beyond = (position - held) * spacing
        beyond[:, 2] = np.minimum(beyond[:, 2], 0.0)
        node = held.astype(np.int64)
        weight, slope = _weights((held - node).T)
        _, ny, nz = self.grid.shape
        start = ((node[:, 0] - 1) * ny + node[:, 1] - 1) * nz + node[:, 2] - 1
        flat = self.coefficients.ravel()
        gap = np.zeros(len(points))
        gradient = np.zeros((3, len(points)))
        for i in range(4):
            for j in range(4):
                value, upward = np.zeros((2, len(points)))
                for k in range(4):
                    coefficient = flat.take(start + ((i * ny + j) * nz + k))
                    value += weight[k][2] * coefficient
                    upward += slope[k][2] * coefficient
                across = weight[i][0] * weight[j][1]
                gap += across * value
                gradient[0] += slope[i][0] * weight[j][1] * value
                gradient[1] += weight[i][0] * slope[j][1] * value
                gradient[2] += across * upward
        steepness = np.linalg.norm(gradient, axis=0)
        some = steepness > FLAT * spacing
        normal = np.where(some, gradient / np.where(some, steepness, 1.0), [[0.0], [0.0], [-1.0]]).T
        return gap + np.einsum("ij,ij->i", normal, beyond), normal


def coefficients(values: Array) -> Array:
    """Return the coefficients of the spline with these values at the nodes."""
    from scipy.ndimage import spline_filter

    return np.asarray(spline_filter(values, order=3, output=np.float64, mode="mirror"))


def _weights(fraction: Array) -> tuple[list[Array], list[Array]]:
    """Return the four cubic B-splines and their derivatives at `fraction` of a cell's width.

    De Boor, A Practical Guide to Splines (1978), chapter X, for even knots.
    """
    left = 1 - fraction
    weight = [
        left**3 / 6,
        (4 + fraction * fraction * (3 * fraction - 6)) / 6,
        (4 + left * left * (3 * left - 6)) / 6,
        fraction**3 / 6,
    ]
    slope = [
        -left * left / 2,
        fraction * (3 * fraction - 4) / 2,
        -left * (3 * left - 4) / 2,
        fraction * fraction / 2,
    ]
    return weight, slope


# Triangles of a closed body: read from an STL file, checked, and oriented tip down.

Unit = Literal["um", "mm", "cm", "m", "inch"]
Up = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
Axis = Literal["middle", "file"]
UNITS: tuple[Unit, ...] = get_args(Unit)
UPS: tuple[Up, ...] = get_args(Up)
AXES: tuple[Axis, ...] = get_args(Axis)
METRES: dict[Unit, float] = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0, "inch": 25.4e-3}

# Readers of other files than STL, by suffix: of content and name to vertices and triangles.
READERS: dict[str, Callable[[bytes, str], tuple[Array, Array]]] = {}
# Bytes before the first triangle of a binary file, and bytes per triangle.
HEADER, RECORD = 84, 50
# Limits of an indenter's longest side [m]; others are assumed to be a wrong unit.
SIZE_MIN, SIZE_MAX = 0.5e-3, 0.2
# Least volume of a body, as a fraction of the longest side cubed.
FLAT_TRIANGLE = 1e-5
# Fraction of the height that counts as an end of the body, for comparing their areas.
END = 0.02
# Ratio of the lower end's area to the upper one's above which the tip is probably up.
WIDER = 1.2


@dataclass(frozen=True, slots=True, eq=False)
class Triangles:
    """Closed surface in the indenter's frame, lowest point at z = 0, z away from the skin."""

    vertices: Array
    """Positions of the vertices (V, 3) [m]."""
    faces: NDArray[np.int32]
    """Vertices of each triangle (F, 3), anticlockwise when seen from outside."""
    notes: tuple[str, ...]
    """Remarks on repairs and suspicious features."""


def read_triangles(data: bytes, name: str, unit: Unit, up: Up, axis: Axis) -> Triangles:
    """Read the body in an STL file, or of a YAML file's parts; options are those of `from_stl`."""
    mesh = _read(data, name)
    if not np.isfinite(mesh.vertices).all():
        count = int((~np.isfinite(mesh.vertices).all(axis=1)).sum())
        raise SceneError(f"{name}: {count} corners that are not finite; allowed: none")
    size = float(np.ptp(mesh.vertices, axis=0).max()) * METRES[unit]
    if not SIZE_MIN <= size <= SIZE_MAX:
        raise SceneError(
            f"{name}: {size * 1e3:.4g} mm long, read in {unit}; allowed: {SIZE_MIN * 1e3:g} to "
            f"{SIZE_MAX * 1e3:g} mm (is the file in another unit?)"
        )
    mesh.merge_vertices()
    faces = np.asarray(mesh.faces)
    # Triangles with merged corners have no area; without them their neighbours meet.
    faces = faces[(np.diff(np.sort(faces, axis=1), axis=1) > 0).all(axis=1)]
    _check_closed(faces, name)
    vertices = np.asarray(mesh.vertices, np.float64) * METRES[unit]
    volume = _volume(vertices, faces)
    if abs(volume) <= FLAT_TRIANGLE * size**3:
        raise SceneError(
            f"{name}: encloses {volume * 1e9:.3g} mm^3; allowed: a body, not a flat sheet"
        )
    notes = []
    if volume < 0:
        faces = faces[:, ::-1]
        notes.append(f"{name} is inside out: its triangles were turned round")
    vertices = _turned(vertices, up, axis)
    notes += _tip_up(vertices, faces, name, up)
    return Triangles(vertices, np.ascontiguousarray(faces, np.int32), tuple(notes))


def _read(data: bytes, name: str) -> Trimesh:
    import trimesh

    if reader := READERS.get(Path(name).suffix):
        return trimesh.Trimesh(*reader(data, name), process=False)
    _check_whole(data, name)
    try:
        with warnings.catch_warnings():
            # NumPy only warns of numbers that it cannot read, and continues with a partial result.
            warnings.simplefilter("error", DeprecationWarning)
            mesh = trimesh.load_mesh(io.BytesIO(data), file_type="stl", process=False)
    except (ValueError, IndexError, DeprecationWarning) as error:
        raise SceneError(f"{name}: {error}; allowed: numbers that can be read") from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise SceneError(f"{name}: no triangles; allowed: a closed body")
    return mesh


def _check_whole(data: bytes, name: str) -> None:
    """Check that a file is complete, by the length and counts in it."""
    count = int.from_bytes(data[HEADER - 4 : HEADER], "little")
    if len(data) >= HEADER and len(data) == HEADER + RECORD * count:
        if count == 0:
            raise SceneError(f"{name}: no triangles; allowed: a closed body")
        return
    if data.lstrip()[:5].lower() != b"solid" or b"\0" in data:
        message = (
            f"{count} triangles, {HEADER + RECORD * count} bytes" if len(data) >= HEADER else ""
        )
        raise SceneError(
            f"{name}: {len(data)} bytes; allowed: an STL file, "
            + (f"here of {message} (is it cut short?)" if message else f"of {HEADER} bytes or more")
        )
    words = re.findall(rb"^[ \t]*(solid|facet|vertex|endfacet|endsolid)\b", data.lower(), re.M)
    counts = Counter(words)
    if counts[b"facet"] == 0 and counts[b"solid"] == counts[b"endsolid"]:
        raise SceneError(f"{name}: no triangles; allowed: a closed body")
    whole = counts[b"endfacet"] == counts[b"facet"] and counts[b"vertex"] == 3 * counts[b"facet"]
    if not whole or counts[b"endsolid"] != counts[b"solid"]:
        raise SceneError(
            f"{name}: {counts[b'facet']} triangles begun, {counts[b'endfacet']} ended, "
            f"{counts[b'vertex']} corners, {counts[b'endsolid']} endsolid; allowed: 3 corners to a "
            "triangle and all of them ended (is it cut short?)"
        )


def _check_closed(faces: NDArray[np.int64], name: str) -> None:
    """Check that triangles leave no gap, and that neighbours are oriented consistently."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    ends = np.sort(np.column_stack([start, end]), axis=1)
    _, edge, count = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    open_ = int((count % 2 == 1).sum())
    if open_ or not len(faces):
        raise SceneError(
            f"{name}: not watertight, {open_} open edges; allowed: none (repair it where it was "
            "drawn)"
        )
    balance = np.bincount(edge.ravel(), weights=np.where(start < end, 1, -1))
    against = int((balance != 0).sum())
    if against:
        raise SceneError(
            f"{name}: {against} edges whose two triangles disagree on which side is out; allowed: "
            "none (repair it where it was drawn)"
        )


def _volume(vertices: Array, faces: NDArray[np.int64]) -> float:
    """Return the enclosed volume [m^3], below 0 if inside out."""
    first, second, third = (vertices[faces[:, corner]] - vertices[0] for corner in range(3))
    return float(np.einsum("ij,ij->", first, np.cross(second, third)) / 6)


def _turned(vertices: Array, up: Up, axis: Axis) -> Array:
    """Return the vertices with `up` as z and their lowest point at z = 0."""
    along = "xyz".index(up[1])
    vertices = np.roll(vertices, 2 - along, axis=1)
    if up[0] == "-":
        vertices = vertices * [1.0, -1.0, -1.0]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle = (low + high) / 2 if axis == "middle" else np.zeros(3)
    return np.asarray(vertices - [middle[0], middle[1], low[2]])


def _tip_up(vertices: Array, faces: NDArray[np.int64], name: str, up: Up) -> list[str]:
    """Return a note if the pressing end is the wider one, as the base of an indenter is."""
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    plan = np.abs(np.cross(second - first, third - first)[:, 2]) / 2
    height = vertices[:, 2].max()
    lower = (vertices[faces, 2] < END * height).all(axis=1)
    upper = (vertices[faces, 2] > (1 - END) * height).all(axis=1)
    below, above = plan[lower].sum() * 1e6, plan[upper].sum() * 1e6
    if below <= WIDER * above or above == 0:
        return []
    other = ("-" if up[0] == "+" else "+") + up[1]
    return [
        f"the end of {name} that presses is flat and wider than the other, {below:.3g} against "
        f"{above:.3g} mm^2: if it is the base, up={other!r} turns the tip down"
    ]


# Level set of a distance on a grid, as triangles that preserve sharp edges.

Whole = NDArray[np.int64]

# The four cells around an edge of the grid, as steps back along the two other axes.
AROUND = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
# Iterations for every crossed edge.
PASSES = 3
# Least eigenvalue of a cell's planes, relative to the largest. Directions below it are free: the
# normals are within about 10 degrees of the others' plane.
SHARP = 0.01


def level_surface(
    values: Array, grid: NodeGrid, function: Callable[[Array], tuple[Array, Array]]
) -> tuple[Array, NDArray[np.int32]]:
    """Return vertices (V, 3) [m] and triangles (F, 3) of the surface where `values` [m] are 0.

    This is dual contouring (Ju et al. 2002). Every crossed cell gets one vertex, where the planes
    of the surface at the crossed edges meet, so that corners and edges between flat faces are
    exact. Triangles are not oriented and may overlap, which does not matter for distances. The
    function returns distance (N,) and gradient (N, 3) at places (N, 3) near the surface.
    """
    lower, axis = _crossed_edges(values <= 0)
    upper = lower + np.eye(3, dtype=np.int64)[axis]
    crossing, normal, above = _crossings(
        (grid.positions(lower), values[tuple(lower.T)]),
        (grid.positions(upper), values[tuple(upper.T)]),
        function,
    )
    cells = _cells_around(lower, axis, grid)
    on_grid = cells >= 0
    number, vertex = np.unique(cells[on_grid], return_inverse=True)
    edge = np.nonzero(on_grid)[0]
    offset = np.einsum("ij,ij->i", normal, crossing) - above
    corner = grid.positions(np.column_stack(np.unravel_index(number, grid.shape)))
    vertices = _where_planes_meet(vertex, normal[edge], offset[edge], crossing[edge], len(number))
    # Planes may meet slightly outside their cell, and the corner is then there.
    vertices = np.clip(vertices, corner - grid.spacing, corner + 2 * grid.spacing)

    quads = np.full(cells.shape, -1)
    quads[on_grid] = vertex
    quads = quads[on_grid.all(axis=1)]
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return vertices, faces.astype(np.int32)


def _crossed_edges(inside: NDArray[np.bool_]) -> tuple[Whole, Whole]:
    """Return lower node (N, 3) and axis (N,) of every grid edge with exactly one end inside."""
    lower, axes = [], []
    for axis in range(3):
        nodes = np.argwhere(np.diff(inside, axis=axis))
        lower.append(nodes)
        axes.append(np.full(len(nodes), axis))
    return np.concatenate(lower), np.concatenate(axes)


def _crossings(
    lower: tuple[Array, Array],
    upper: tuple[Array, Array],
    function: Callable[[Array], tuple[Array, Array]],
) -> tuple[Array, Array, Array]:
    """Return the crossings of edges (N, 3), with gradient and remaining value of the function.

    The ends are given with the function's values; false position narrows them. The remaining value
    shifts the plane along the gradient, which is exact for a plane.
    """
    (low, at_low), (high, at_high) = lower, upper
    for turn in range(PASSES):
        fraction = at_low / (at_low - at_high)
        point = low + fraction[:, None] * (high - low)
        value, gradient = function(point)
        if turn < PASSES - 1:
            like_low = (value > 0) == (at_low > 0)
            low = np.where(like_low[:, None], point, low)
            high = np.where(like_low[:, None], high, point)
            at_low, at_high = np.where(like_low, value, at_low), np.where(like_low, at_high, value)
    return point, gradient, value


def _cells_around(lower: Whole, axis: Whole, grid: NodeGrid) -> Whole:
    """Return indices of the four cells around edges (N, 4), by their lowest node; -1 if none."""
    cells = np.repeat(lower[:, None, :], 4, axis=1)
    every = np.arange(len(lower))
    for turn in (0, 1):
        cells[every, :, (axis + 1 + turn) % 3] -= AROUND[:, turn]
    there = ((cells >= 0) & (cells < np.array(grid.shape) - 1)).all(axis=2)
    numbers = np.full(there.shape, -1)
    numbers[there] = np.ravel_multi_index(tuple(cells[there].T), grid.shape)
    return numbers


def _where_planes_meet(
    vertex: Whole, normal: Array, offset: Array, crossing: Array, count: int
) -> Array:
    """Return the points (count, 3) that are nearest to their planes, normal . x = offset.

    The least-squares problem is solved relative to the mean of the crossings, and only along
    directions that the planes determine.
    """

    def summed(values: Array) -> Array:
        return np.bincount(vertex, values, count).astype(np.float64)

    planes = summed(np.ones(len(vertex)))
    mean = np.stack([summed(crossing[:, i]) / planes for i in range(3)], axis=1)
    short = offset - np.einsum("ij,ij->i", normal, mean[vertex])
    pull = np.stack([summed(normal[:, i] * short) for i in range(3)], axis=1)
    squares = np.empty((count, 3, 3))
    for i in range(3):
        for j in range(i + 1):
            squares[:, i, j] = squares[:, j, i] = summed(normal[:, i] * normal[:, j])
    size, along = np.linalg.eigh(squares)
    firm = size > SHARP * size[:, 2:]
    step = np.einsum("nij,ni->nj", along, pull) * firm / np.where(firm, size, 1.0)
    return np.asarray(mean + np.einsum("nij,nj->ni", along, step))


# Default spacing of the grid, and its height above the tip [m].
SPACING, REACH = 0.1e-3, 5e-3
# Margin of the grid around the body [m]; places beyond are far (see `device.FAR`).
MARGIN = 1.2e-3
# Distance from the rounded surface up to which distances are exact [m]; beyond they are close.
EXACT = 0.5e-3
# Most nodes of a grid; a node takes 8 bytes, and 100 during construction.
NODES_MAX = 16_000_000
# Most nodes of a grid that is as fine as a chosen edge radius needs.
NODES_UNASKED = 4_500_000
# Room for a ball on a grid, over its radius; and share of the faces that press that is none.
ROOM, VANISHED = 1.2, 0.05
# Least edge radius, in spacings, that the grid resolves.
FINENESS = 1.5
# Largest loss of material by rounding, in radii. A corner between walls at 20 degrees loses 4.8;
# a larger loss means that a wall is too narrow for the radius.
LOSS_MAX = 5.0
# Distance of a curved surface from its facets [m] above which there is a note.
BULGE_NOTED = 5e-6
# Shortening of the tip, in edge radii, above which there is a note.
LIFT_NOTED = 0.05
# Largest fraction of the surface that may be buried in the body or face inwards.
MISPLACED_MAX = 1e-3


@dataclass(frozen=True, slots=True)
class Solid:
    """Body from a file; equality depends on the file's content, not on its path.

    The file is read when a distance is first needed, and must then still have the same content.

    Raises:
        SceneError: A unit or direction is unknown, or the grid is out of range.
    """

    path: str = field(compare=False)
    sha256: str
    unit: Unit = "mm"
    """Unit of the numbers in the file."""
    up: Up = "+z"
    """Axis of the file that points away from the skin."""
    axis: Axis = "middle"
    """Origin of x and y: the middle of the bounding box, or the file's axis."""
    spacing: float = SPACING
    """Spacing of the grid of distances [m]."""
    reach: float = REACH
    """Height above the tip up to which the body is sampled [m]; above, it continues straight up."""
    sharpest: float = field(default=0.0, compare=False)
    """Radius [m] that no convex part of the body is sharper than; 0 with an edge."""
    unasked: float = field(default=0.0, compare=False)
    """Edge radius [m] that was chosen for the body, for lack of a given one."""
    notes: tuple[str, ...] = field(default=(), compare=False)
    """Remarks on repairs and suspicious features."""

    def __post_init__(self) -> None:
        check_choice("solid.unit", self.unit, UNITS)
        check_choice("solid.up", self.up, UPS)
        check_choice("solid.axis", self.axis, AXES)
        check_range("solid", "spacing", self.spacing, 5e-6, 1e-3, unit="m")
        check_range("solid", "reach", self.reach, 4 * self.spacing, 0.1, unit="m")

    def triangles(self) -> Triangles:
        """Return the body's surface.

        Raises:
            SceneError: The file is missing, its content has changed, or it holds no body.
        """
        return _triangles(replace(self, spacing=SPACING, reach=REACH))

    def surface(self) -> Surface:
        """Return points on the body below `reach`.

        Raises:
            SceneError: As `triangles`.
        """
        return _surface(replace(self, spacing=SPACING))

    def distances(self, edge_radius: float) -> Field:
        """Return the signed distance to the body with convex edges rounded to `edge_radius` [m].

        Raises:
            SceneError: As `triangles`; or the body has no room for the radius.
        """
        return _distances(self, edge_radius)


def with_edges(solid: Solid, edge_radius: float | None, spacing: float | None) -> Solid:
    """Return the body with its remarks, and with an edge radius if none is given.

    A body whose edges are all round as drawn gets none. Others get the largest of `RADII` that
    leaves the faces that press and their corners, as far as a grid resolves it; none if nothing
    that presses is left. The grid is as fine as that radius needs, if no `spacing` [m] is given.
    """
    surface = solid.surface()
    sharpest, unasked = surface.sharpest(), 0.0
    if edge_radius is None and sharpest < FINENESS * solid.spacing:
        nodes = _grid(solid.triangles(), 0.0, solid).count
        for radius in RADII:
            step = solid.spacing if spacing else min(SPACING, radius / FINENESS)
            if radius < FINENESS * step or nodes * (solid.spacing / step) ** 3 > NODES_UNASKED:
                break
            unasked, solid = radius, replace(solid, spacing=step)
            if surface.suits(radius):
                break
        if surface.pressing(surface.fits(ROOM * unasked)) < VANISHED:
            unasked = 0.0
    solid = replace(solid, sharpest=sharpest, unasked=unasked)
    radius = unasked if edge_radius is None else edge_radius
    notes = solid.triangles().notes + solid.distances(radius).notes
    return replace(solid, notes=notes)


def digest(data: bytes) -> str:
    """Return the SHA-256 of a file's content."""
    return hashlib.sha256(data).hexdigest()


@lru_cache(maxsize=32)
def _triangles(solid: Solid) -> Triangles:
    path = Path(solid.path)
    wanted = f"the file with SHA-256 {solid.sha256[:12]}..., which this indenter was made from"
    if not path.is_file():
        raise SceneError(f"solid.path: {solid.path}: no such file; allowed: {wanted}")
    data = path.read_bytes()
    checksum = digest(data)
    if checksum != solid.sha256:
        raise SceneError(
            f"solid.path: {solid.path} has changed, its SHA-256 is {checksum[:12]}...; allowed: "
            f"{wanted}"
        )
    triangles = read_triangles(data, path.name, solid.unit, solid.up, solid.axis)
    from sim.indenters.nearest import misplaced_share

    misplaced = misplaced_share(triangles.vertices, triangles.faces)
    if misplaced > MISPLACED_MAX:
        raise SceneError(
            f"{path.name}: {100 * misplaced:.2g} % of its surface does not separate inside from "
            "outside; allowed: none of it (unite shells that overlap where they were drawn)"
        )
    vertices, faces, bulge, angle = curved(triangles.vertices, triangles.faces.astype(np.int64))
    notes = triangles.notes
    if bulge > BULGE_NOTED:
        notes += (
            f"facets of {path.name}, up to {math.degrees(angle):.2g} degrees to each other, are "
            f"read as a curved surface, up to {bulge * 1e3:.2g} mm beyond them",
        )
    lowest = [0.0, 0.0, float(vertices[:, 2].min())]
    return Triangles(vertices - lowest, np.ascontiguousarray(faces, np.int32), notes)


@lru_cache(maxsize=16)
def _nearest(solid: Solid) -> Nearest:
    from sim.indenters.nearest import Nearest

    triangles = solid.triangles()
    return Nearest(triangles.vertices, triangles.faces, closed=True)


@lru_cache(maxsize=4)
def _surface(solid: Solid) -> Surface:
    triangles = solid.triangles()
    return Surface.of(_nearest(solid), triangles.vertices, triangles.faces, solid.reach)


@lru_cache(maxsize=8)
def _gaps(solid: Solid, grid: NodeGrid, exact: float) -> Array:
    """Return the signed distance to the unrounded body at the nodes, exact up to `exact` [m]."""
    return _nearest(solid).signed_at_nodes(grid, exact)


@lru_cache(maxsize=16)
def _distances(solid: Solid, radius: float) -> Field:
    """See `Solid.distances`.

    A body is rounded to the volume that a ball of that radius can reach inside it. The centres of
    balls that fit inside form a smaller body; the gap is the distance from it minus the radius.
    """
    from sim.indenters.nearest import Nearest

    name = Path(solid.path).name
    if 0 < radius < FINENESS * solid.spacing * (1 - 1e-9):  # 0.15 mm fits 1.5 times 0.1 mm
        raise SceneError(
            f"edge_radius: {radius:g} m of {name}; allowed: 0, or from "
            f"{FINENESS * solid.spacing:g} m on a grid of {solid.spacing:g} m"
        )
    triangles, whole = solid.triangles(), _nearest(solid)
    grid = _grid(triangles, radius, solid)
    gap = _gaps(solid, grid, max(EXACT, radius + 2 * solid.spacing))
    lift, notes = 0.0, []
    if radius <= solid.sharpest:
        radius = 0.0
    thick, long = solid.surface().removed(max(radius, solid.spacing / 2))
    if thick:
        why = f"rounding {name} to {radius * 1e3:g} mm" if radius else f"its grid for {name}"
        notes.append(
            f"{why} removes parts up to {thick * 1e3:.2g} mm thick, {long * 1e3:.2g} mm long"
        )
    if radius:
        if not (gap <= -radius).any():
            raise SceneError(f"edge_radius: {radius:g} m leaves nothing of {name}; allowed: less")

        # The core's surface, and every grid edge that it crosses, is inside the body.
        def within(places: Array) -> tuple[Array, Array]:
            length, away = whole.distance(places)
            return radius - length, -away

        vertices, faces = level_surface(gap + radius, grid, within)
        # Half a step, so that no node is on the limit by rounding errors alone.
        outside = gap > -radius - EXACT - solid.spacing / 2
        core = Nearest(vertices, faces, closed=False).distance_at_nodes(
            grid, EXACT + radius, outside
        )
        rounded = np.where(gap <= -radius, -core, core) - radius
        loss = float(rounded[np.abs(gap) < solid.spacing].max())
        if loss > LOSS_MAX * radius:
            raise SceneError(
                f"edge_radius: {radius:g} m takes {loss:.2g} m off {name}; allowed: less, up to "
                "half of its narrowest wall"
            )
        gap, lift = rounded, max(0.0, float(vertices[:, 2].min()) - radius)
        if lift > LIFT_NOTED * radius:
            notes.append(
                f"rounding {name} to {radius * 1e3:g} mm took {lift * 1e3:.3g} mm off its tip"
            )
    low, high = _extent(triangles, solid.reach)
    top = high[2] - lift if high[2] <= solid.reach else math.inf
    return Field(
        grid,
        coefficients(gap),
        lift,
        bounds=((low[0], high[0]), (low[1], high[1]), (0.0, top)),
        notes=tuple(notes),
    )


def _grid(triangles: Triangles, radius: float, solid: Solid) -> NodeGrid:
    """Return nodes around the lower part of a body, as high as distances within `reach` need."""
    low, high = _extent(triangles, solid.reach)
    # The spline depends on a few nodes around a place; rounding, on all within the radius.
    top = min(high[2] + MARGIN, solid.reach + max(MARGIN, radius + 6 * solid.spacing))
    ends = np.array([*(low - MARGIN), high[0] + MARGIN, high[1] + MARGIN, top]) / solid.spacing
    first = SKIP * ((np.floor(ends[:3]).astype(int) - 2) // SKIP)
    last = np.ceil(ends[3:]).astype(int) + 2
    shape = last - first + 1
    count = int(np.prod(shape))
    if count > NODES_MAX:
        raise SceneError(
            f"solid.spacing: {solid.spacing:g} m makes {count:,} nodes; allowed: up to "
            f"{NODES_MAX:,}, by a larger spacing or less reach"
        )
    first_x, first_y, first_z = first.tolist()
    nx, ny, nz = shape.tolist()
    return NodeGrid((first_x, first_y, first_z), (nx, ny, nz), solid.spacing)


def _extent(triangles: Triangles, reach: float) -> tuple[Array, Array]:
    """Return corners (3,), (3,) [m] of a box around all triangles with a part below `reach`."""
    near = triangles.vertices[triangles.faces, 2].min(axis=1) <= reach
    corners = triangles.vertices[np.unique(triangles.faces[near])]
    return corners.min(axis=0), corners.max(axis=0)
