"""Where an indenter comes: the part of a body that is meshed finely."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

from sim.fem.mesh import Array, Mesh, Window, axes, build_mesh
from sim.fem.numerics import Numerics
from sim.indenters import Indenter
from sim.scene import Scene

SPACING_SHARE = 6
"""Elements through the thickness when no spacing is given."""
SAMPLES, LEVELS, PASSES = 61, 6, 2
"""Points along x and y, and heights, at which an indenter is looked at;
the second pass looks only where the first has found it."""
MARGIN = 1.0
"""Width of the rim around the footprint that is meshed finely too, in fine elements."""


def meshes_of(scenes: Sequence[Scene], numerics: Numerics) -> list[Mesh]:
    """The meshes that scenes are solved on; `Numerics.one_topology` makes their counts agree.

    Raises:
        SceneError: See `mesh.cell_counts`.
    """
    plans = [
        (scene.body, *_spacing_and_window(scene, numerics), numerics.grading) for scene in scenes
    ]
    least = (0, 0)
    if numerics.one_topology:
        counts = np.array([[len(places) - 1 for places in axes(*plan)] for plan in plans])
        least = (int(counts[:, 0].max()), int(counts[:, 1].max()))
    return [build_mesh(*plan, at_least=least) for plan in plans]


def mesh_of(scene: Scene, numerics: Numerics) -> Mesh:
    """The mesh that a scene is solved on alone.

    Raises:
        SceneError: See `mesh.cell_counts`.
    """
    return meshes_of([scene], numerics)[0]


def _spacing_and_window(scene: Scene, numerics: Numerics) -> tuple[float, Window | None]:
    spacing = numerics.spacing
    if spacing is None:
        spacing = scene.body.thickness / SPACING_SHARE
    return spacing, contact_window(scene, MARGIN * spacing) if numerics.graded else None


def contact_window(scene: Scene, margin: float) -> Window:
    """A box in plan around all that the indenter covers of the untouched top, and `margin` [m]."""
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
    """A box in plan around an indenter's lowest `depth`, up to `reach` from the tip [m]."""
    x, y = np.clip(indenter.bounds_below(depth)[:2], -reach, reach).tolist()
    return tuple(x), tuple(y)


@functools.lru_cache(maxsize=1024)
def _footprint(indenter: Indenter, depth: float, sides: Window) -> tuple[Array, Array]:
    """Least and greatest x and y [m] of an indenter's lowest `depth`, inside of a box around it.

    Found on a grid of points, and widened by what may lie between them.
    """
    low, high = np.transpose(sides)
    heights = np.linspace(0.0, depth, LEVELS)
    for _pass in range(PASSES):
        x, y = (np.linspace(low[axis], high[axis], SAMPLES) for axis in (0, 1))
        places = np.stack(np.meshgrid(x, y, heights, indexing="ij"), axis=-1)
        covered = indenter.distance(places)[0].min(axis=2) <= 0
        if not covered.any():
            return np.zeros(2), np.zeros(2)
        between = (high - low) / (SAMPLES - 1)
        in_x, in_y = (np.unique(place) for place in np.nonzero(covered))
        least = np.array([x[in_x[0]], y[in_y[0]]]) - between
        most = np.array([x[in_x[-1]], y[in_y[-1]]]) + between
        low, high = np.maximum(least, low), np.minimum(most, high)
    return low, high
