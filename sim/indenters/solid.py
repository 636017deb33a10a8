"""A body in an STL file: which file, how it is turned, and the signed distance to it."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.checks import check_range
from sim.errors import SceneError
from sim.indenters.field import Field, Grid, coefficients
from sim.indenters.rounding import level_surface
from sim.indenters.triangles import AXES, UNITS, UPS, Axis, Triangles, Unit, Up, read_triangles

Array = NDArray[np.float64]

SPACING, REACH = 0.1e-3, 5e-3
"""Of the grid, and how far above the tip it goes, unless told otherwise [m]."""
MARGIN = 1.2e-3
"""How far around the body distances are known [m]; what is farther is far (see `device.FAR`)."""
EXACT = 0.5e-3
"""How far from the rounded surface distances are exact [m]; from there on they are good."""
NODES_MAX = 16_000_000
"""Nodes of a grid; a node takes 8 bytes, and 100 while it is made."""
FINENESS = 1.5
"""Least edge radius, in spacings: a smaller one is none to the grid."""
LOSS_MAX = 5.0
"""Most that rounding may take off anywhere, in radii: a corner between walls at 20 degrees loses
4.8; what loses more is no corner, but a wall too narrow for the radius."""
LIFT_NOTED = 0.05
"""Shortening of the tip, in edge radii, that is worth a note."""
MISPLACED_MAX = 1e-3
"""Share of the surface that may be buried in the body or face inwards."""


@dataclass(frozen=True, slots=True)
class Solid:
    """A body by its file; where that lies does not matter for being equal.

    Nothing is read before a distance is asked for, and then only a file with the very same content
    will do.

    Raises:
        SceneError: An unknown unit or direction, or a grid that makes no sense.
    """

    path: str = field(compare=False)
    sha256: str
    """Digest of the file's content."""
    unit: Unit = "mm"
    """Of the numbers in the file."""
    up: Up = "+z"
    """Axis of the file that points away from the skin."""
    axis: Axis = "middle"
    """What becomes x = y = 0: the middle of the box around the body, or the file's own axis."""
    spacing: float = SPACING
    """Between the nodes of the grid of distances [m]."""
    reach: float = REACH
    """How far above the tip the body is known [m]; above, it goes on straight up."""
    notes: tuple[str, ...] = field(default=(), compare=False)
    """What was repaired in the body or looks odd about it."""

    def __post_init__(self) -> None:
        for name, word, allowed in (
            ("unit", self.unit, UNITS),
            ("up", self.up, UPS),
            ("axis", self.axis, AXES),
        ):
            if word not in allowed:
                raise SceneError(f"solid.{name}: {word!r}; allowed: {', '.join(allowed)}")
        check_range("solid", "spacing", self.spacing, 5e-6, 1e-3, unit="m")
        check_range("solid", "reach", self.reach, 4 * self.spacing, 0.1, unit="m")

    def triangles(self) -> Triangles:
        """The body's surface.

        Raises:
            SceneError: The file is not there, has another content, or holds no body.
        """
        return _triangles(self)

    def distances(self, edge_radius: float) -> Field:
        """The signed distance to the body, its convex edges rounded to `edge_radius` [m].

        Raises:
            SceneError: See `triangles`; or a radius that the body has no room for.
        """
        return _distances(self, edge_radius)


def digest(data: bytes) -> str:
    """What tells contents of files apart."""
    return hashlib.sha256(data).hexdigest()


@lru_cache(maxsize=32)
def _triangles(solid: Solid) -> Triangles:
    path = Path(solid.path)
    wanted = f"the file with SHA-256 {solid.sha256[:12]}..., which this indenter was made from"
    if not path.is_file():
        raise SceneError(f"solid.path: {solid.path}: no such file; allowed: {wanted}")
    data = path.read_bytes()
    found = digest(data)
    if found != solid.sha256:
        raise SceneError(
            f"solid.path: {solid.path} has changed, its SHA-256 is {found[:12]}...; allowed: "
            f"{wanted}"
        )
    triangles = read_triangles(data, path.name, solid.unit, solid.up, solid.axis)
    from sim.indenters.nearest import misplaced_share

    misplaced = misplaced_share(triangles.vertices, triangles.faces)
    if misplaced > MISPLACED_MAX:
        raise SceneError(
            f"{path.name}: {100 * misplaced:.2g} % of its surface does not part inside from "
            "outside; allowed: none of it (unite shells that overlap where they were drawn)"
        )
    return triangles


@lru_cache(maxsize=16)
def _distances(solid: Solid, radius: float) -> Field:
    """See `Solid.distances`.

    A body is rounded by what a ball of that radius can reach from within: the points from which
    the ball fits inside are a smaller body, and the gap is the distance from that, less the radius.
    """
    from sim.indenters.nearest import Nearest

    name = Path(solid.path).name
    if 0 < radius < FINENESS * solid.spacing:
        raise SceneError(
            f"edge_radius: {radius:g} m of {name}; allowed: 0, or from "
            f"{FINENESS * solid.spacing:g} m on a grid of {solid.spacing:g} m"
        )
    triangles = solid.triangles()
    grid = _grid(triangles, radius, solid)
    whole = Nearest(triangles.vertices, triangles.faces, closed=True)
    exact = EXACT + radius
    gap = whole.signed_at_nodes(grid, exact)
    lift, notes = 0.0, []
    if radius:
        if not (gap <= -radius).any():
            raise SceneError(f"edge_radius: {radius:g} m leaves nothing of {name}; allowed: less")

        # The core's surface, and every edge of the grid that it crosses, is within the body.
        def within(places: Array) -> tuple[Array, Array]:
            length, away = whole.distance(places)
            return radius - length, -away

        vertices, faces = level_surface(gap + radius, grid, within)
        core = Nearest(vertices, faces, closed=False).distance_at_nodes(grid, exact)
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


def _grid(triangles: Triangles, radius: float, solid: Solid) -> Grid:
    """Nodes around the lower part of a body, as far up as distances within `reach` need them."""
    low, high = _extent(triangles, solid.reach)
    # The spline at a node feels few others; what is rounded, all within the radius.
    top = min(high[2] + MARGIN, solid.reach + radius + 6 * solid.spacing)
    ends = np.array([*(low - MARGIN), high[0] + MARGIN, high[1] + MARGIN, top]) / solid.spacing
    first, last = np.floor(ends[:3]).astype(int) - 2, np.ceil(ends[3:]).astype(int) + 2
    shape = last - first + 1
    count = int(np.prod(shape))
    if count > NODES_MAX:
        raise SceneError(
            f"solid.spacing: {solid.spacing:g} m makes {count:,} nodes; allowed: up to "
            f"{NODES_MAX:,}, by a larger spacing or less reach"
        )
    first_x, first_y, first_z = first.tolist()
    nx, ny, nz = shape.tolist()
    return Grid((first_x, first_y, first_z), (nx, ny, nz), solid.spacing)


def _extent(triangles: Triangles, reach: float) -> tuple[Array, Array]:
    """A box (3,), (3,) [m] around all triangles that come within reach."""
    near = triangles.vertices[triangles.faces, 2].min(axis=1) <= reach
    corners = triangles.vertices[np.unique(triangles.faces[near])]
    return corners.min(axis=0), corners.max(axis=0)
