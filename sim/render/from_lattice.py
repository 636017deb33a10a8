# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""From the displacement of the untouched image back to where material points are seen."""

import functools

import numpy as np
import warp as wp

from recorder.markers import Lattice
from sim.render.lens import Lens, seen
from sim.render.vertices import DeviceTop

LAYERS = 4
"""Layers of places beside the gel that are given a displacement before anything is drawn: four
values around a point of its border reach two of them, three where the image is turned."""


def without_gaps(field: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The field (F, R, C, 2) gone on straight from its known places (R, C); 0 far beyond them.

    A place that has two known ones in a row beside it goes on from them, from several such pairs
    in the mean; then its neighbours do, `LAYERS` times.
    """
    field = field.astype(np.float32)
    field[:, ~known] = 0
    for _ in range(LAYERS):
        total = np.zeros_like(field)
        count = np.zeros(known.shape, int)
        for row, column in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            near, far = (_shifted(known, row * k, column * k) for k in (1, 2))
            pair = near & far & ~known
            values = [_shifted(field, row * k, column * k) for k in (1, 2)]
            total[:, pair] += (2 * values[0] - values[1])[:, pair]
            count += pair
        new = count > 0
        field[:, new] = total[:, new] / count[new][:, None]
        known = known | new
    return field


def _shifted(values: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Each place's neighbour so many rows and columns on; 0 or False beyond the border."""
    axes = (0, 1) if values.ndim == 2 else (1, 2)
    found = np.roll(values, (-rows, -columns), axis=axes)
    for axis, shift in zip(axes, (rows, columns), strict=True):
        edge = [slice(None)] * values.ndim
        edge[axis] = slice(-shift, None) if shift > 0 else slice(0, -shift)
        if shift:
            found[tuple(edge)] = 0
    return found


@functools.cache
def _vertices_kernel():
    @wp.func
    def weights(t: float):
        """Catmull and Rom's four weights between evenly spaced values."""
        return wp.vec4(
            0.5 * t * ((2.0 - t) * t - 1.0),
            0.5 * (t * t * (3.0 * t - 5.0) + 2.0),
            0.5 * t * ((4.0 - 3.0 * t) * t + 1.0),
            0.5 * t * t * (t - 1.0),
        )

    @wp.kernel(enable_backward=False, module="unique")
    def vertices(
        # Settings:
        lens: Lens,
        step: float,
        margin: float,
        # Untouched top:
        x: wp.array[float],
        y: wp.array[float],
        height: wp.array2d[float],
        # In: displacement of the untouched image
        field: wp.array3d[wp.vec2],
        # Out: column, row, nearness
        vertex_out: wp.array3d[wp.vec3],
    ):
        frame, i, j = wp.tid()
        before = seen(lens, wp.vec3(x[i], y[j], height[i, j]))
        rows, columns = field.shape[1], field.shape[2]
        across = wp.clamp((before[0] + margin) / step, 0.0, float(columns - 1))
        down = wp.clamp((before[1] + margin) / step, 0.0, float(rows - 1))
        column = wp.min(int(across), columns - 2)
        row = wp.min(int(down), rows - 2)
        weight_column = weights(across - float(column))
        weight_row = weights(down - float(row))
        moved = wp.vec2()
        for a in range(4):
            r = wp.clamp(row + a - 1, 0, rows - 1)
            along = wp.vec2()
            for b in range(4):
                c = wp.clamp(column + b - 1, 0, columns - 1)
                along += field[frame, r, c] * weight_column[b]
            moved += along * weight_row[a]
        vertex_out[frame, i, j] = wp.vec3(before[0] + moved[0], before[1] + moved[1], before[2])

    return vertices


def vertices_from_lattice(lens: Lens, top: DeviceTop, lattice: Lattice, field) -> wp.array:
    """Vertices (F, N, M) of the top, moved in the image by a field (F, R, C) of vec2 [px].

    The field does not say how near to the camera anything is: vertices are as near as untouched.
    """
    device = field.device
    shape = (field.shape[0], len(top.x), len(top.y))
    out = wp.empty(shape, dtype=wp.vec3, device=device)
    wp.launch(
        _vertices_kernel(),
        dim=shape,
        inputs=[
            lens,
            float(lattice.step_px),
            float(lattice.margin_px),
            top.x,
            top.y,
            top.height,
            field,
        ],
        outputs=[out],
        device=device,
    )
    return out
