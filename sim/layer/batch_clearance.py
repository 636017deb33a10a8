# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Gaps between undeformed bodies and indenters on a device, for a batch of presses.

The same as `sim.layer.contact.Clearance`, except that heights are computed under every pixel
wherever the tip is, instead of interpolated between samples.
"""

import functools
import math
from collections.abc import Sequence

import numpy as np
import warp as wp

from sim.indenters.device import PartTable, distance_function, table_struct
from sim.indenters.indenter import STRIDE, TOUCHING
from sim.layer.batch_kernels import fields_struct
from sim.layer.contact import (
    COVERED_LEAST,
    COVERED_MOST,
    FINE,
    FINEST,
    REACH,
    THIN,
    WALL,
    YIELDING,
    clearance_cap,
    endless,
)
from sim.layer.spectral import PixelGrid
from sim.scalars import numpy_of
from sim.scene import Scene

MM = 1e-3
# Most bisections and Newton steps to a surface; Newton's method takes 3 or 4.
CROSSINGS = 60


@functools.cache
def clearance_struct(real):
    """Return the struct of pixels, and of the samples of each kind of indenter."""
    triple = wp.types.vector(3, real)

    class RimSamples:
        # Pixels: centres (nx,), (ny,), undeformed heights (P,), 1 on the body (P,), and widths
        x: wp.array(dtype=real)
        y: wp.array(dtype=real)
        surface: wp.array(dtype=real)
        on_body: wp.array(dtype=wp.int32)
        pixel: triple
        # Per environment: kind of its indenter, and height above which nothing touches
        kind: wp.array(dtype=wp.int32)
        cap: wp.array(dtype=real)
        # Per kind: height to look up to; begin of its samples, rows and columns; its left edges
        reach: wp.array(dtype=real)
        layout: wp.array2d(dtype=wp.int32)
        edge: wp.array2d(dtype=real)
        # Distances of samples; and their heights, inf where there is nothing, or a wall
        step: triple
        height: wp.array(dtype=real)
        covered: wp.array(dtype=real)

    return wp.struct(RimSamples)


@functools.cache
def clearance_kernels(real, traits):
    """Return the kernels (sample, cover, clear) for one precision and kind of indenters."""
    table_type = table_struct(real, traits)
    distance = distance_function(real, traits)
    triple, samples_type = wp.types.vector(3, real), clearance_struct(real)
    zero, one, half = real(0.0), real(1.0), real(0.5)
    stride, thin, mm = real(STRIDE), real(THIN), real(MM)
    touching = real(TOUCHING / MM if real == wp.float64 else 1e-6)
    settled = real(1e-9 if real == wp.float64 else 2e-7)
    nothing = real(wp.inf)

    @wp.func
    def height_above(table: table_type, kind: int, x: real, y: real, reach: real):
        """Return the height of the lower surface above x, y, all in mm; inf if there is none."""
        low = zero
        high = zero
        gap = distance(table, kind, triple(x, y, zero))[3]
        while gap > touching and high <= reach:
            low = high
            high = high + stride * gap + thin * reach
            gap = distance(table, kind, triple(x, y, high))[3]
        if gap > touching:
            return nothing
        here = half * (low + high)
        turn = int(0)
        while turn < CROSSINGS and high - low > settled:
            answer = distance(table, kind, triple(x, y, here))
            if answer[3] > zero:
                low = here
            else:
                high = here
            turn += 1
            after = half * (low + high)
            if answer[2] < zero and turn % 4 > 0:
                newton = here - answer[3] / answer[2]
                if newton >= low and newton <= high:
                    after = newton
                    if wp.abs(newton - here) < settled:
                        turn = int(CROSSINGS)
            here = after
        return here

    @wp.kernel(enable_backward=False, module="unique")
    def sample(table: table_type, samples: samples_type):
        kind, i, j = wp.tid()
        count = samples.layout[kind, 2]
        if i < samples.layout[kind, 1] and j < count:
            x = (samples.edge[kind, 0] + (real(i) + half) * samples.step[0]) / mm
            y = (samples.edge[kind, 1] + (real(j) + half) * samples.step[1]) / mm
            height = mm * height_above(table, kind, x, y, samples.reach[kind])
            samples.height[samples.layout[kind, 0] + i * count + j] = height

    @wp.kernel(enable_backward=False, module="unique")
    def cover(
        # In: samples on each side among which the lowest counts, and the highest wall that is none
        wide_x: int,
        wide_y: int,
        wall: real,
        samples: samples_type,
    ):
        kind, i, j = wp.tid()
        layout = samples.layout
        begin, rows, count = layout[kind, 0], layout[kind, 1], layout[kind, 2]
        if i >= rows or j >= count:
            return
        mine = samples.height[begin + i * count + j]
        lowest = mine
        for a in range(wp.max(i - wide_x, 0), wp.min(i + wide_x + 1, rows)):
            for b in range(wp.max(j - wide_y, 0), wp.min(j + wide_y + 1, count)):
                lowest = wp.min(lowest, samples.height[begin + a * count + b])
        if mine - lowest < wall:
            samples.covered[begin + i * count + j] = mine
        else:
            samples.covered[begin + i * count + j] = nothing

    @wp.func
    def within(low: real, high: real, cell: int):
        return wp.max(zero, wp.min(high, real(cell + 1)) - wp.max(low, real(cell)))

    @wp.kernel(enable_backward=False, module="unique")
    def clear(
        samples: samples_type,
        table: table_type,
        # In: top above which the least gap is looked for
        which: wp.array(dtype=wp.int32),
        tip: wp.array(dtype=triple),
        moved: wp.array2d(dtype=wp.vec3),
        # Out: gap [m], how much more pixels yield, and the least gap
        fields: fields_struct(real),
        least_out: wp.array(dtype=real),
    ):
        row, p = wp.tid()
        env = which[row]
        ny = samples.y.shape[0]
        at = triple(samples.x[p // ny], samples.y[p % ny], zero) - tip[row]
        kind = samples.kind[env]
        layout, pixel, edge, step = samples.layout, samples.pixel, samples.edge, samples.step
        part = one
        mean = zero
        if layout[kind, 1] > 0:
            begin, rows, count = layout[kind, 0], layout[kind, 1], layout[kind, 2]
            west = (at[0] - half * pixel[0] - edge[kind, 0]) / step[0]
            east = (at[0] + half * pixel[0] - edge[kind, 0]) / step[0]
            south = (at[1] - half * pixel[1] - edge[kind, 1]) / step[1]
            north = (at[1] + half * pixel[1] - edge[kind, 1]) / step[1]
            part = zero
            for i in range(wp.max(int(wp.floor(west)), 0), wp.min(int(wp.ceil(east)), rows)):
                across = within(west, east, i)
                for j in range(wp.max(int(wp.floor(south)), 0), wp.min(int(wp.ceil(north)), count)):
                    height = samples.covered[begin + i * count + j]
                    if height < nothing:
                        weight = across * within(south, north, j)
                        part += weight
                        mean += weight * height
            if part > zero:
                mean = mean / part
            part = part * step[0] * step[1] / (pixel[0] * pixel[1])
        gap = samples.cap[env]
        extra = zero
        if samples.on_body[p] > 0:
            if part >= real(COVERED_LEAST):
                if part < real(COVERED_MOST):
                    gap = wp.min(mean, samples.cap[env])
                    extra = real(YIELDING) * (one / part - one)
                else:
                    above = height_above(table, kind, at[0] / mm, at[1] / mm, samples.reach[kind])
                    gap = wp.min(mm * above, samples.cap[env])
            gap = gap + tip[row][2] - samples.surface[p]
        fields.gap[env, p] = gap
        fields.extra[env, p] = extra
        wp.atomic_min(least_out, env, gap - real(moved[env, p][2]))

    return sample, cover, clear


class BatchClearance:
    """Gaps under the indenters of a batch of scenes with the same body, on one device."""

    def __init__(self, scenes: Sequence[Scene], grid: PixelGrid, real, device) -> None:
        """Sample the rims of all indenters that the motions can bring over the body."""
        body, number = grid.body, numpy_of(real)
        surface = body.heights(grid.x, grid.y)
        caps = [clearance_cap(scene.motion, body, surface) for scene in scenes]
        keys = [
            (scene.indenter, REACH * math.ceil(cap / REACH))
            for scene, cap in zip(scenes, caps, strict=True)
        ]
        kinds = list(dict.fromkeys(keys))
        number_of = {key: index for index, key in enumerate(kinds)}
        far = max(float(np.abs(np.asarray(scene.motion.tip)[:, :2]).max()) for scene in scenes)
        span = far + 0.5 * max(body.size_x, body.size_y) + max(grid.pixel)

        count = [min(FINEST, math.ceil(pixel / FINE)) for pixel in grid.pixel]
        step = [pixel / many for pixel, many in zip(grid.pixel, count, strict=True)]
        layout, edges, total = [], [], 0
        for indenter, reach in kinds:
            many, edge = [0, 0], [0.0, 0.0]
            if not endless(indenter):
                box = indenter.bounds_below(reach)[:2]
                for axis, (width, (low, high)) in enumerate(zip(step, box, strict=True)):
                    middle, low, high = (low + high) / 2, max(low, -span), min(high, span)
                    begin = math.floor((low - middle) / width) - 1
                    many[axis] = max(0, math.ceil((high - middle) / width) + 2 - begin)
                    edge[axis] = middle + (begin - 0.5) * width
            layout.append((total, *many))
            edges.append(edge)
            total += math.prod(many)

        def array(values, dtype=real):
            return wp.array(values, dtype=dtype, device=device)

        packed = PartTable.pack([kind for kind, _ in kinds], MM, real, device)
        self._table = packed.struct
        sample, cover, self._clear = clearance_kernels(real, packed.traits)
        triple = wp.types.vector(3, real)
        on_body = body.covers(grid.x[:, None], grid.y)
        samples = self.samples = clearance_struct(real)()
        """Pixels and samples on the device."""
        samples.x, samples.y = array(grid.x.astype(number)), array(grid.y.astype(number))
        samples.surface = array(surface.ravel().astype(number))
        on_body = np.broadcast_to(on_body, grid.shape).ravel()
        samples.on_body = array(on_body.astype(np.int32), wp.int32)
        samples.pixel, samples.step = triple(*grid.pixel, 0.0), triple(*step, 0.0)
        samples.kind = array([number_of[key] for key in keys], wp.int32)
        samples.cap = array(np.array(caps, number))
        samples.reach = array([reach / MM for _, reach in kinds])
        samples.layout = array(np.array(layout, np.int32), wp.int32)
        samples.edge = array(np.array(edges, number))
        samples.height = wp.empty(max(total, 1), dtype=real, device=device)
        samples.covered = wp.empty_like(samples.height)
        everything = (len(kinds), *np.array(layout)[:, 1:].max(axis=0).tolist())
        wp.launch(sample, everything, [self._table, samples], device=device)
        near = [many // 2 for many in count]
        wall = WALL / 2 * max(grid.pixel)
        wp.launch(cover, everything, [*near, wall, samples], device=device)

    def at(self, which, tip, moved, fields, least_out) -> None:
        """Write gaps [m] and yielding (B, P) of presses `which` (N,) with tips at (N,) [m].

        `least_out` (B,) becomes the smaller of itself and the least gap above the top displaced by
        `moved` (B, P).
        """
        shape, inputs = (len(which), moved.shape[1]), [self.samples, self._table, which, tip, moved]
        wp.launch(self._clear, shape, inputs, [fields, least_out], device=moved.device)
