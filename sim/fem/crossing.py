# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Test on the GPU whether a folded skin needs a closer look; it never says no to one that does.

`sim.fem.self_overlap` looks at skins on the host, which the GPU waits for. Most of them are bent
around an edge and touch nothing. Here each surface node around the folded faces is tested against
the bounding boxes of all elements, and against planes that an element lies on one side of, as
there but with a margin for float32. Only where a node passes both is there anything to look at.

For each surface node of each environment, `NODE_LANES` threads share the elements: few
environments have folds, and one thread for each of their nodes does not fill a GPU (5 ms a test
on an H200). On a CPU it takes longer than the look itself.
"""

import functools

import numpy as np
import warp as wp

from sim.device import kernel
from sim.fem.arrays import mesh_struct
from sim.fem.self_overlap import SIDES
from sim.scalars import vector_of

# Part of an element's size by which a node may be outside of it and still be looked at. Places have
# 24 bits, and the smallest elements about a thousandth of a body's size.
MARGIN = 1e-3
# Threads that go through the elements for one node.
NODE_LANES = 32
# Marks in the column of folds of `OVERLAPS`, where a face folded has 1.
MAY_CROSS = 2.0


@functools.cache
def _kernels(real):
    vec3 = vector_of(real)
    mat83 = wp.types.matrix(shape=(8, 3), dtype=real)
    zero, margin, mark = real(0.0), real(MARGIN), real(MAY_CROSS)

    @wp.func
    def extent(low: vec3, high: vec3):
        return wp.max(wp.max(high[0] - low[0], high[1] - low[1]), high[2] - low[2])

    @kernel()
    def surround(
        mesh: mesh_struct(real),
        active: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
        face_overlap: wp.array3d(dtype=real),
        # Out: least and greatest corner of the folded faces, and the greatest extent of one (B, 7)
        box_out: wp.array2d(dtype=real),
    ):
        env, s = wp.tid()
        if active[env] == 0 or face_overlap[env, s, 3] == zero:
            return
        m = mesh.variant[env]
        low = mesh.nodes[m, mesh.faces[s, 0]] + u[env, mesh.faces[s, 0]]
        high = low
        for corner in range(1, 4):
            place = mesh.nodes[m, mesh.faces[s, corner]] + u[env, mesh.faces[s, corner]]
            low = wp.min(low, place)
            high = wp.max(high, place)
        for axis in range(3):
            wp.atomic_min(box_out, env, axis, low[axis])
            wp.atomic_max(box_out, env, 3 + axis, high[axis])
        wp.atomic_max(box_out, env, 6, extent(low, high))

    @kernel()
    def cross(
        mesh: mesh_struct(real),
        sides: wp.array2d(dtype=wp.int32),
        skin: wp.array(dtype=wp.int32),
        active: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
        box: wp.array2d(dtype=real),
        # In and out:
        most_out: wp.array2d(dtype=real),
    ):
        env, s, lane = wp.tid()
        if active[env] == 0 or box[env, 6] <= zero:
            return
        m = mesh.variant[env]
        node = skin[s]
        point = mesh.nodes[m, node] + u[env, node]
        around = box[env, 6] * (real(1.0) + margin)
        for axis in range(3):
            if point[axis] < box[env, axis] - around or point[axis] > box[env, 3 + axis] + around:
                return
        corner = mat83()
        for e in range(lane, mesh.elements.shape[0], NODE_LANES):
            low = vec3()
            high = vec3()
            apart = int(0)
            for c in range(8):
                n = mesh.elements[e, c]
                if n == node:
                    apart = int(1)
                away = mesh.nodes[m, n] + u[env, n] - point
                corner[c] = away
                if c == 0:
                    low = away
                    high = away
                low = wp.min(low, away)
                high = wp.max(high, away)
            slack = margin * extent(low, high)
            for axis in range(3):
                if low[axis] > slack or high[axis] < -slack:
                    apart = int(1)
            if apart == 0:
                for side in range(6):
                    first = corner[sides[2, side]] - corner[sides[0, side]]
                    second = corner[sides[3, side]] - corner[sides[1, side]]
                    normal = wp.cross(first, second)
                    below = wp.dot(normal, corner[0])
                    above = below
                    for c in range(1, 8):
                        height = wp.dot(normal, corner[c])
                        below = wp.min(below, height)
                        above = wp.max(above, height)
                    room = margin * wp.max(wp.abs(below), wp.abs(above))
                    if below > room or above < -room:
                        apart = int(1)
            if apart == 0:
                most_out[env, 3] = mark
                return

    return surround, cross


class Crossing:
    """The test for B environments with the same surface, faces (S, 4); it owns a work array."""

    def __init__(self, real, environments: int, faces: np.ndarray, device: str) -> None:
        self._device, (self._surround, self._cross) = device, _kernels(real)
        self._skin = wp.array(np.unique(faces).astype(np.int32), dtype=wp.int32, device=device)
        self._sides = wp.array(SIDES.astype(np.int32), dtype=wp.int32, device=device)
        none = np.repeat([np.inf, -np.inf, 0.0], [3, 3, 1])
        self._none = wp.array(np.tile(none, (environments, 1)), dtype=real, device=device)
        self._box = wp.clone(self._none)

    def marked(self, folds: np.ndarray) -> np.ndarray:
        """True where the column of folds (B,) has the mark of `mark`."""
        return folds == MAY_CROSS

    def mark(self, mesh, active, u, face_overlap, most_overlap) -> None:
        """Write `MAY_CROSS` into the last column of `most_overlap` (B, 4) where a look is needed.

        Both overlaps are as measured by `overlap_kernel`, those of faces (B, S, 4).
        """
        wp.copy(self._box, self._none)
        by_face, inputs = (len(self._box), len(mesh.faces)), [mesh, active, u, face_overlap]
        wp.launch(self._surround, by_face, inputs, [self._box], device=self._device)
        by_lane = len(self._box), len(self._skin), NODE_LANES
        inputs = [mesh, self._sides, self._skin, active, u, self._box]
        wp.launch(self._cross, by_lane, inputs, [most_overlap], device=self._device)
