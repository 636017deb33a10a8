# mypy: ignore-errors
# (Warp reads the annotations of its kernels as values, which no type checker follows.)
"""Distances from points to triangles, by Warp's bounding volume hierarchy."""

import math
from functools import cache
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.ndimage import label

from sim.arrays import Array
from sim.indenters.grid import SKIP, NodeGrid

# Unit of the queries: the tree is in float32, for numbers around 1.
MM = 1e-3
# Largest distance of a query, beyond any surface, in that unit.
FARTHEST = 1e6
# Groups of triangles farther than this multiple of their size are approximated as one (Barill et
# al., Fast winding numbers for soups and clouds, 2018).
ACCURACY = 2.0
# Distance below which the triangle's normal is used as direction [mm].
TOUCHING = 1e-5
# Points per launch.
QUERIES_AT_ONCE = 1 << 20


class Nearest:
    """Nearest-point queries on a surface with vertices (V, 3) [m] and triangles (F, 3)."""

    def __init__(
        self, vertices: Array, faces: NDArray[np.int32], *, closed: bool, device: str = "cpu"
    ) -> None:
        """Build the tree; `closed` is True if the surface has an inside."""
        self._device = device
        self._mesh = wp.Mesh(
            points=wp.array(vertices / MM, dtype=wp.vec3, device=device),
            indices=wp.array(faces.ravel(), dtype=wp.int32, device=device),
            support_winding_number=closed,
        )

    def distance(self, points: Array) -> tuple[Array, Array]:
        """Return distance (N,) [m] at points (N, 3) [m], and its unit gradient."""
        return self._queried(points, False, 0.0)

    def signed(self, points: Array, winding: float = 0.5) -> tuple[Array, Array]:
        """As `distance`, negative where the winding number exceeds `winding`; many times slower."""
        return self._queried(points, True, winding)

    def distance_at_nodes(
        self, grid: NodeGrid, exact: float, where: NDArray[np.bool_] | bool = True
    ) -> Array:
        """Return the distance (grid.shape) [m] at a grid's nodes, exact at least up to `exact` [m].

        Farther away, and not `where`, it is interpolated between every `SKIP`-th node.
        """
        weights = [_between(count) for count in grid.shape]
        nodes = np.indices([weight.shape[1] for weight in weights]) * SKIP
        coarse = self.distance(grid.positions(nodes.reshape(3, -1).T))[0].reshape(nodes.shape[1:])
        length = np.einsum("ia,jb,kc,abc->ijk", *weights, coarse, optimize=True)
        # A distance changes by at most the distance between two places, so that the mean of those
        # at a cell's corners is off by at most half its diagonal.
        near = where & (length <= exact + math.sqrt(3) / 2 * SKIP * grid.spacing)
        length[near] = self.distance(grid.positions(np.argwhere(near)))[0]
        return length

    def signed_at_nodes(self, grid: NodeGrid, exact: float) -> Array:
        """As `distance_at_nodes`, but negative inside a closed surface.

        Neighbours that are both farther from the surface than from each other are on the same side.
        The sign is therefore computed at one node of each such region, and at every nearer node.
        """
        length = self.distance_at_nodes(grid, exact)
        regions, _ = label(length > 1.001 * grid.spacing)
        _, some = np.unique(regions, return_index=True)
        one_each = grid.positions(np.column_stack(np.unravel_index(some, grid.shape)))
        inside = (self.signed(one_each)[0] < 0)[regions]
        near = regions == 0
        inside[near] = self.signed(grid.positions(np.argwhere(near)))[0] < 0
        return np.where(inside, -length, length)

    def _queried(self, points: Array, signed: bool, winding: float) -> tuple[Array, Array]:
        gap, direction = np.empty(len(points)), np.empty((len(points), 3))
        for first in range(0, len(points), QUERIES_AT_ONCE):
            some = slice(first, first + QUERIES_AT_ONCE)
            queries = wp.array(points[some] / MM, dtype=wp.vec3, device=self._device)
            answers = wp.empty(len(queries), dtype=wp.vec4, device=self._device)
            inputs, kernel = [self._mesh.id, winding, queries], _nearest_kernel(signed)
            wp.launch(kernel, len(queries), inputs, [answers], device=self._device)
            answer = answers.numpy()
            gap[some], direction[some] = answer[:, 3] * np.float64(MM), answer[:, :3]
        return gap, direction


def _between(count: int) -> Array:
    """Return weights (count, coarse nodes) of coarse nodes, which reach to the end or beyond."""
    coarse = np.arange(0, count + SKIP - 1, SKIP)
    return np.maximum(1 - np.abs(np.arange(count)[:, None] - coarse) / SKIP, 0.0)


@cache
def _nearest_kernel(signed: bool) -> Any:
    """Return the kernel of direction and distance at each point, signed or not."""

    @wp.kernel(enable_backward=False, module="unique")
    def nearest(
        # Settings:
        mesh: wp.uint64,
        winding: float,
        # In:
        points: wp.array[wp.vec3],
        # Out:
        nearest_out: wp.array[wp.vec4],
    ):
        i = wp.tid()
        p = points[i]
        if wp.static(signed):
            hit = wp.mesh_query_point_sign_winding_number(mesh, p, FARTHEST, ACCURACY, winding)
        else:
            hit = wp.mesh_query_point_no_sign(mesh, p, FARTHEST)
        away = p - wp.mesh_eval_position(mesh, hit.face, hit.u, hit.v)
        length = wp.length(away)
        direction = wp.mesh_eval_face_normal(mesh, hit.face)
        if wp.static(signed):
            length *= hit.sign
        if wp.abs(length) > TOUCHING:
            direction = away / length
        nearest_out[i] = wp.vec4(direction[0], direction[1], direction[2], length)

    return nearest


def misplaced_share(vertices: Array, faces: NDArray[np.int32]) -> float:
    """Return the fraction of a closed surface's area that does not separate inside from outside.

    A triangle separates them if the winding number is 1 just inside it and 0 just outside. Shells
    that overlap or are inside out do not.
    """
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    normal = np.cross(second - first, third - first) / 2
    area = np.linalg.norm(normal, axis=1)
    some = area > 0
    middle = ((first + second + third) / 3)[some]
    out = normal[some] / area[some, None] * (1e-4 * np.ptp(vertices, axis=0).max())
    near = Nearest(vertices, faces, closed=True)

    def winds(points: Array, more_than: float) -> NDArray[np.bool_]:
        return near.signed(points, more_than)[0] < 0

    right = winds(middle - out, 0.5) & ~winds(middle - out, 1.5)
    right &= winds(middle + out, -0.5) & ~winds(middle + out, 0.5)
    return float(area[some][~right].sum() / area.sum())
