"""Initial positions of the particles, their grid, and the schedule of time steps."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.arrays import Array
from sim.errors import SceneError
from sim.mpm import (
    AUTHORS_DENSITY,
    AUTHORS_LAYERS,
    AUTHORS_STEP,
    AUTHORS_VOLUME,
    SAFETY,
    SPEED_RATIO,
    STABLE,
    WINDOW,
    Mpm,
)
from sim.scene import Body, Scene

# Height of the base plane above the lowest grid node [cells]: the spline reaches 1.5 down.
BASE_NODE = 2
# Cells of air next to and above the body, beyond the bulge that the press is expected to cause.
ROOM = 3
PARTICLES_MOST = 50_000_000


@dataclass(frozen=True, slots=True)
class ParticleLattice:
    """Particles of a body at rest and its background grid; lengths in cells, from a corner's base.

    That corner, least in x, y and z, is a grid node. Particles run along y, then x, then upwards:
    the lowest layer is first.
    """

    cell: float
    """Edge of a cell [m]."""
    nodes: tuple[int, int, int]
    """Number of grid nodes along x, y and z."""
    corner: tuple[int, int, int]
    """Indices of the grid node at the body's corner."""
    origin: Array
    """Position of the contact frame's origin (3,)."""
    rest: Array
    """Positions of the particles (P, 3)."""
    volume: Array
    """Volume of each particle (P,)."""
    counts: tuple[int, int, int]
    """Number of particles along x, y and z."""
    held: int
    """Number of fixed particles, which are the first."""
    surface_x: Array
    """x of the columns of particles [m] (X,)."""
    surface_y: Array
    """y of the columns of particles [m] (Y,)."""
    to_surface: Array
    """Offsets from particles of the highest layer to the top above them (X Y, 3)."""

    @property
    def node_count(self) -> int:
        """Number of grid nodes."""
        return self.nodes[0] * self.nodes[1] * self.nodes[2]


def build_lattice(scenes: Sequence[Scene], numerics: Mpm) -> ParticleLattice:
    """Return the particles of the body that the scenes share, on a grid with room for all scenes.

    Columns of particles under a dome are shortened to fit, and their volumes with them.
    """
    body = scenes[0].body
    cell = numerics.cell_in(body)
    spacing = cell / numerics.per_cell
    sizes = (body.size_x, body.size_y, body.thickness)
    on_faces = numerics.published is not None
    counts = tuple(round(size / spacing) + int(on_faces) for size in sizes)
    nx, ny, nz = counts
    if min(counts) < 2 or nx * ny * nz > PARTICLES_MOST:
        raise SceneError(
            f"mpm.cell: {cell!r} m with {numerics.per_cell:g} particles per cell gives "
            f"{nx} x {ny} x {nz} particles; allowed: 2 or more along each axis, "
            f"{PARTICLES_MOST:,} in all"
        )
    along = [_positions(count, on_faces) for count in counts]
    x, y = (along[0] - 0.5) * body.size_x, (along[1] - 0.5) * body.size_y
    top = body.heights(x, y)
    column = body.thickness + top
    points = np.empty((nz, nx, ny, 3))
    points[..., 0] = x[:, None]
    points[..., 1] = y
    points[..., 2] = -body.thickness + along[2][:, None, None] * column
    volume = np.full(counts[2:] + counts[:2], body.size_x * body.size_y / (nx * ny * nz)) * column
    if numerics.published is not None:
        volume[:] = AUTHORS_VOLUME
    to_surface = np.zeros((nx, ny, 3))
    to_surface[..., 2] = top - points[-1, ..., 2]
    nodes, corner = _grid(scenes, cell)
    origin = np.array([body.size_x / 2, body.size_y / 2, body.thickness]) / cell
    return ParticleLattice(
        cell=cell,
        nodes=nodes,
        corner=corner,
        origin=origin,
        rest=points.reshape(-1, 3) / cell + origin,
        volume=volume.ravel() / cell**3,
        counts=(nx, ny, nz),
        held=0 if numerics.published is None else nx * ny * min(AUTHORS_LAYERS, nz),
        surface_x=x,
        surface_y=y,
        to_surface=to_surface.reshape(-1, 3) / cell,
    )


def _positions(count: int, on_faces: bool) -> Array:
    """Return positions of particles along an edge, from 0 to 1."""
    if on_faces:
        return np.linspace(0.0, 1.0, count)
    return (np.arange(count) + 0.5) / count


def _grid(
    scenes: Sequence[Scene], cell: float
) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
    """Return the number of nodes along each axis, and the indices of the body's corner."""
    body = scenes[0].body
    squeezed = max(scene.motion.depth_max for scene in scenes) / 2 + body.thickness / 20
    room = ROOM + math.ceil(squeezed / cell)
    x, y, z = (math.ceil(size / cell) for size in (body.size_x, body.size_y, body.thickness))
    return (x + 2 * room + 1, y + 2 * room + 1, BASE_NODE + z + room + 1), (room, room, BASE_NODE)


# Mass of the body, duration of a time step, and the step of each waypoint.

# Tip speed over wave speed above which a press does not count as quasi-static.
QUASI_STATIC = 0.03
# Time for which the tip stands still where its motion has a hold, by our settings [slowest periods
# of the layer].
STANDING = 4.0
# Speed of the tip if its motion has none [m/s].
ENTRY_SPEED = 10e-3
# Most steps: the readings of this many take 360 MB.
STEPS_MOST = 5_000_000


@dataclass(frozen=True, slots=True)
class Pace:
    """Mass, time step and schedule of one scene."""

    mass_scaling: float
    """Mass over real mass."""
    wave_speed: float
    """Speed of pressure waves in the body with that mass [m/s]."""
    time_step: float
    """Duration of a time step [s]."""
    courant: float
    """Wave speed * time step / cell."""
    tip_speed: float
    """Largest speed of the tip [m/s]."""
    corners: Array
    """Start and waypoints in the contact frame (F + 1, 3) [m]."""
    at: NDArray[np.int64]
    """Step after which the tip is at each corner (F + 1,)."""
    window: int
    """Number of steps to which a frame's force is fitted."""

    @property
    def steps(self) -> int:
        """Number of steps of the whole motion."""
        return int(self.at[-1])

    @property
    def speed_ratio(self) -> float:
        """Tip speed over wave speed."""
        return self.tip_speed / self.wave_speed


def pace_of(scene: Scene, numerics: Mpm, cell: float) -> Pace:
    """Return the mass and the schedule of a scene on a grid with cells of this size [m]."""
    body = scene.body
    tip = np.asarray(scene.motion.tip, float)
    # A start straight above the first waypoint, if that is inside the body.
    start = [*tip[0, :2], max(tip[0, 2], 0.0)]
    corners = np.concatenate([[start], tip])
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    durations = np.diff(np.asarray(scene.motion.time))
    speeds = lengths[1:] / durations
    tip_speed = float(speeds.max(initial=0.0)) or ENTRY_SPEED
    scaling = (SPEED_RATIO * wave_speed(body) / tip_speed) ** 2
    if numerics.published is not None:
        scaling = AUTHORS_DENSITY / body.density
    speed = wave_speed(body, scaling)
    step = _time_step(numerics, cell, speed)
    entry = [lengths[0] / tip_speed]
    period = 4 * body.thickness / math.sqrt(body.shear_modulus / (body.density * scaling))
    if numerics.published is None:
        durations = np.where(lengths[1:] > 0, lengths[1:] / tip_speed, STANDING * period)
    moments = np.concatenate([[0.0], np.cumsum(np.concatenate([entry, durations]))])
    if moments[-1] / step > STEPS_MOST:
        raise SceneError(
            f"motion: {moments[-1]:.3g} s are {moments[-1] / step:.3g} steps of {step:.3g} s; "
            f"allowed: {STEPS_MOST:,} steps"
        )
    at = np.round(moments / step).astype(np.int64)
    for index in range(1, len(at)):
        # Each waypoint gets a separate step, except a start that is the first waypoint.
        at[index] = max(at[index], at[index - 1] + (index > 1 or lengths[0] > 0))
    return Pace(
        mass_scaling=scaling,
        wave_speed=speed,
        time_step=step,
        courant=speed * step / cell,
        tip_speed=tip_speed,
        corners=corners,
        at=at,
        window=math.ceil(WINDOW * body.thickness / speed / step),
    )


def wave_speed(body: Body, mass_scaling: float = 1.0) -> float:
    """Return the speed of pressure waves, sqrt((K + 4/3 G) / density) [m/s]."""
    return math.sqrt(body.wave_modulus / (body.density * mass_scaling))


def _time_step(numerics: Mpm, cell: float, speed: float) -> float:
    if numerics.published is None:
        return SAFETY * cell / speed
    limit = STABLE * cell / speed
    if limit < AUTHORS_STEP:
        raise SceneError(
            f"mpm.published: time steps of {AUTHORS_STEP:g} s; allowed in this body: up to "
            f"{limit:.3g} s, in which a wave at {speed:.3g} m/s crosses {STABLE:g} of a cell of "
            f"{cell * 1e3:.3g} mm"
        )
    return AUTHORS_STEP
