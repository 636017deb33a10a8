# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Where the camera sees the material points of the top: (frame, x, y) -> column, row, nearness."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from sim.render.cubic import TAPS, Taps
from sim.render.lens import Lens, seen
from sim.render.top import Top


@dataclass(frozen=True, slots=True)
class DeviceTop:
    """A `Top` on a device."""

    x: wp.array
    y: wp.array
    height: wp.array

    @classmethod
    def of(cls, top: Top, device):
        """Copy it there."""
        values = (top.x, top.y, top.height)
        return cls(*(wp.array(value.astype(np.float32), device=device) for value in values))


@wp.func
def moved_by(
    surface: wp.array3d[wp.vec3],
    frame: int,
    first_x: int,
    first_y: int,
    weight_x: wp.vec4,
    weight_y: wp.vec4,
):
    """Displacement at a place, from the four by four values around it."""
    total = wp.vec3()
    for a in range(wp.static(TAPS)):
        along = wp.vec3()
        for b in range(wp.static(TAPS)):
            along += surface[frame, first_x + a, first_y + b] * weight_y[b]
        total += along * weight_x[a]
    return total


@functools.cache
def _kernel():
    @wp.kernel(enable_backward=False, module="unique")
    def vertices(
        # Settings:
        lens: Lens,
        # Untouched top:
        x: wp.array[float],
        y: wp.array[float],
        height: wp.array2d[float],
        # Taps along x and y:
        first_x: wp.array[int],
        weight_x: wp.array[wp.vec4],
        first_y: wp.array[int],
        weight_y: wp.array[wp.vec4],
        # In: displacement
        surface: wp.array3d[wp.vec3],
        # Out: column, row, nearness
        vertex_out: wp.array3d[wp.vec3],
    ):
        frame, i, j = wp.tid()
        moved = moved_by(surface, frame, first_x[i], first_y[j], weight_x[i], weight_y[j])
        vertex_out[frame, i, j] = seen(lens, wp.vec3(x[i], y[j], height[i, j]) + moved)

    return vertices


def tap_arrays(axes: Sequence[Taps], device) -> list[wp.array]:
    """First values and weights of each axis in turn, on the device."""
    return [
        wp.array(values, dtype=kind, device=device)
        for taps in axes
        for values, kind in ((taps.first, wp.int32), (taps.weight, wp.vec4))
    ]


def see_vertices(lens: Lens, top: DeviceTop, taps_x: Taps, taps_y: Taps, surface) -> wp.array:
    """Vertices (F, N, M) of the displaced top; `surface` is (F, X, Y) of vec3 [m]."""
    device = surface.device
    shape = (surface.shape[0], len(top.x), len(top.y))
    out = wp.empty(shape, dtype=wp.vec3, device=device)
    taps = tap_arrays((taps_x, taps_y), device)
    wp.launch(
        _kernel(),
        dim=shape,
        inputs=[lens, top.x, top.y, top.height, *taps, surface],
        outputs=[out],
        device=device,
    )
    return out
