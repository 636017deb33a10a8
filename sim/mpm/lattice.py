"""Where the particles are before anything moves, and the grid they move on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.body import Body
from sim.errors import SceneError
from sim.mpm.numerics import MpmNumerics
from sim.scene import Scene

Array = NDArray[np.float64]

BASE_NODE = 2
"""Height of the base plane above the lowest grid node [cells]: the spline reaches 1.5 down."""
ROOM = 3
"""Cells of air beside and above the body, beyond what the press is expected to squeeze out."""
PARTICLES_MOST = 50_000_000


@dataclass(frozen=True, slots=True)
class Lattice:
    """Particles of a body at rest and its background grid; lengths in cells, from a corner's base.

    That corner, least in x, y and z, is a grid node. Particles run along y, then x, then upwards:
    the lowest layer is first.
    """

    cell: float
    """Edge of a cell [m]."""
    nodes: tuple[int, int, int]
    """Grid nodes along x, y and z."""
    corner: tuple[int, int, int]
    """Which of the nodes is the body's corner."""
    origin: Array
    """Where the contact frame's origin is (3,)."""
    rest: Array
    """Particles (P, 3)."""
    volume: Array
    """Volume of each (P,)."""
    counts: tuple[int, int, int]
    """Particles along x, y and z."""
    held: int
    """How many of the first particles stand still."""
    surface_x: Array
    """x of the columns of particles [m] (X,)."""
    surface_y: Array
    """The same for y (Y,)."""
    to_surface: Array
    """From each particle of the highest layer straight to the top, at its column's place (X Y, 3).

    Jitter moves the particle off its column; this leads back."""

    @property
    def node_count(self) -> int:
        """Nodes of the grid."""
        return self.nodes[0] * self.nodes[1] * self.nodes[2]


def build_lattice(scenes: Sequence[Scene], numerics: MpmNumerics) -> Lattice:
    """The particles of the body that the scenes share, on a grid with room for all of them.

    Columns of particles under a dome are shortened to fit, their volumes with them.

    Raises:
        SceneError: Fewer than two particles along an axis, or too many in all.
    """
    body = scenes[0].body
    cell = numerics.cell if numerics.cell is not None else body.thickness / 8
    spacing = cell / numerics.per_cell
    sizes = (body.size_x, body.size_y, body.thickness)
    on_faces = numerics.lattice == "faces"
    counts = tuple(round(size / spacing) + int(on_faces) for size in sizes)
    nx, ny, nz = counts
    if min(counts) < 2 or nx * ny * nz > PARTICLES_MOST:
        raise SceneError(
            f"numerics.cell: {cell!r} m with {numerics.per_cell:g} particles per cell gives "
            f"{nx} x {ny} x {nz} particles; allowed: 2 or more along each axis, "
            f"{PARTICLES_MOST:,} in all"
        )
    along = [_places(count, on_faces) for count in counts]
    x, y = (along[0] - 0.5) * body.size_x, (along[1] - 0.5) * body.size_y
    top = body.heights(x, y)
    column = body.thickness + top
    points = np.empty((nz, nx, ny, 3))
    points[..., 0] = x[:, None]
    points[..., 1] = y
    points[..., 2] = -body.thickness + along[2][:, None, None] * column
    regular = points[-1].copy()
    if numerics.jitter:
        moved = np.random.default_rng(numerics.seed).uniform(-1, 1, points.shape)
        points += moved * numerics.jitter * spacing
    volume = np.full(counts[2:] + counts[:2], body.size_x * body.size_y / (nx * ny * nz)) * column
    if numerics.particle_volume is not None:
        volume[:] = numerics.particle_volume
    to_surface = regular - points[-1]
    to_surface[..., 2] = top - points[-1, ..., 2]
    nodes, corner = _grid(scenes, cell)
    origin = np.array([body.size_x / 2, body.size_y / 2, body.thickness]) / cell
    return Lattice(
        cell=cell,
        nodes=nodes,
        corner=corner,
        origin=origin,
        rest=points.reshape(-1, 3) / cell + origin,
        volume=volume.ravel() / cell**3,
        counts=(nx, ny, nz),
        held=nx * ny * min(numerics.base_layers, nz) if numerics.base == "particles" else 0,
        surface_x=x,
        surface_y=y,
        to_surface=to_surface.reshape(-1, 3) / cell,
    )


def _places(count: int, on_faces: bool) -> Array:
    """Places of particles along an edge, from 0 to 1."""
    if on_faces:
        return np.linspace(0.0, 1.0, count)
    return (np.arange(count) + 0.5) / count


def _grid(
    scenes: Sequence[Scene], cell: float
) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
    """Nodes along each axis, and which of them is the body's corner."""
    body = scenes[0].body
    squeezed = max(scene.motion.depth_max for scene in scenes) / 2 + body.thickness / 20
    room = ROOM + math.ceil(squeezed / cell)
    x, y, z = (math.ceil(size / cell) for size in (body.size_x, body.size_y, body.thickness))
    return (x + 2 * room + 1, y + 2 * room + 1, BASE_NODE + z + room + 1), (room, room, BASE_NODE)


def same_body(scenes: Sequence[Scene]) -> Body:
    """The body whose shape all scenes share.

    Raises:
        SceneError: A scene with a body of another shape.
    """
    first = scenes[0].body
    for index, scene in enumerate(scenes):
        for name in ("size_x", "size_y", "thickness", "dome_radius"):
            if getattr(scene.body, name) != getattr(first, name):
                raise SceneError(
                    f"scenes[{index}].body.{name}: {getattr(scene.body, name)!r}; allowed: "
                    f"{getattr(first, name)!r}, as in the batch's first scene"
                )
    return first
