# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""State of a batch of layers on a device: the pixels that touch, steps, and stored frames."""

import functools

import numpy as np
import warp as wp

from sim.layer.batch_contact import PACKED, layer_functions
from sim.scalars import vector_of

READ = np.dtype(
    [
        ("force", float, 3),
        ("torque", float, 3),
        ("energy", float),
        ("touched", float),
        ("least", float),
        ("pressure", float),
        ("excess", float),
        ("box", float, 4),
    ]
)
"""Sums over the pixels: force of the indenter on the body [Pa] and its torque about the tip [Pa m],
traction times displacement [Pa m], number of touched pixels. Then the least gap [m], the largest
pressure, the largest shear less friction [Pa], and the first and last touched pixel along x and y,
the first ones negative."""
COLUMNS = READ.itemsize // 8
SUMS, MAXIMA = 8, 7
# Samples by which a contact is measured, and one more, over the pixels along an axis.
FINER = 2


@functools.cache
def state_kernels(real, friction: bool, lanes: int):
    """Return the kernels (mark, tally, enlist, recall, spread, displace, take, measure)."""
    vec3 = vector_of(real)
    _side, pixel, touches, full = layer_functions(real)
    numbers, vectors = wp.array2d(dtype=real), wp.array2d(dtype=vec3)
    whole = wp.array2d(dtype=wp.int32)
    sums_type = wp.types.vector(length=SUMS, dtype=wp.float64)
    maxima_type = wp.types.vector(length=MAXIMA, dtype=wp.float64)

    @wp.kernel(enable_backward=False, module="unique")
    def mark(
        bulge: real,
        which: wp.array(dtype=wp.int32),
        gap: numbers,
        least: wp.array(dtype=real),
        elastic: vectors,
        # Out: 1 for pixels that may touch
        touching_out: whole,
    ):
        row, p = wp.tid()
        env = which[row]
        near = gap[env, p] < bulge * wp.max(real(0.0), -least[env])
        touching_out[env, p] = wp.where(near or touches(elastic[env, p]), 1, 0)

    @wp.kernel(enable_backward=False, module="unique")
    def tally(ny: int, which: wp.array(dtype=wp.int32), touching: whole, tally_out: whole):
        row, i = wp.tid()
        env = which[row]
        found = int(0)
        for j in range(ny):
            found += touching[env, i * ny + j]
        tally_out[env, i] = found

    @wp.kernel(enable_backward=False, module="unique")
    def enlist(
        ny: int,
        which: wp.array(dtype=wp.int32),
        touching: whole,
        tally: whole,
        # Out: packed places in order, and their number
        listed_out: whole,
        count_out: wp.array(dtype=wp.int32),
    ):
        row, i = wp.tid()
        env = which[row]
        place = int(0)
        for before in range(i):
            place += tally[env, before]
        for j in range(ny):
            if touching[env, i * ny + j] > 0:
                listed_out[env, place] = (i << PACKED) + j
                place += 1
        if i == tally.shape[1] - 1:
            count_out[env] = place

    @wp.kernel(enable_backward=False, module="unique")
    def recall(
        ny: int,
        which: wp.array(dtype=wp.int32),
        count: wp.array(dtype=wp.int32),
        listed: whole,
        elastic: vectors,
        branches: wp.array3d(dtype=vec3),
        factor: wp.array(dtype=real),
        kept: numbers,
        gained: numbers,
        # Out, by the place in the list: traction from the history, and with the displacement as is
        held_out: vectors,
        guess_out: vectors,
        # Out, by pixel: nothing yet
        traction_out: vectors,
        elastic_out: vectors,
    ):
        row, k = wp.tid()
        env = which[row]
        traction_out[env, k] = vec3()
        elastic_out[env, k] = vec3()
        if k >= count[env]:
            return
        p = pixel(listed[env, k], ny)
        held = vec3()
        for b in range(branches.shape[0]):
            held += branches[b, env, p] * kept[row, b] - elastic[env, p] * gained[row, b]
        held_out[env, k] = held
        guess_out[env, k] = elastic[env, p] * factor[row] + held

    @wp.kernel(enable_backward=False, module="unique")
    def spread(
        ny: int,
        which: wp.array(dtype=wp.int32),
        count: wp.array(dtype=wp.int32),
        listed: whole,
        factor: wp.array(dtype=real),
        held: vectors,
        found: vectors,
        # Out: by pixel, and the elastic part by the place in the list
        traction_out: vectors,
        elastic_out: vectors,
        load_out: vectors,
    ):
        row, k = wp.tid()
        env = which[row]
        if k >= count[env]:
            return
        p = pixel(listed[env, k], ny)
        elastic = (found[env, k] - held[env, k]) / factor[row]
        traction_out[env, p] = found[env, k]
        elastic_out[env, p] = elastic
        load_out[env, k] = elastic

    @wp.kernel(enable_backward=False, module="unique")
    def displace(
        ny: int,
        table: wp.array3d(dtype=real),
        which: wp.array(dtype=wp.int32),
        count: wp.array(dtype=wp.int32),
        listed: whole,
        load: vectors,
        # In and out: pixels that may touch; overlap beyond `allowed` adds one, `missed_out` says so
        gap: numbers,
        allowed: wp.array(dtype=real),
        touching: whole,
        missed_out: wp.array(dtype=wp.int32),
        # Out: displacement [m]
        moved_out: wp.array2d(dtype=wp.vec3),
    ):
        row, p = wp.tid()
        env = which[row]
        here = ((p // ny) << PACKED) + p % ny
        moved = vec3()
        for m in range(count[env]):
            moved += full(table, here, listed[env, m], load[env, m], wp.static(int(friction)))
        moved_out[env, p] = wp.vec3(float(moved[0]), float(moved[1]), float(moved[2]))
        if touching[env, p] == 0 and gap[env, p] - moved[2] < -allowed[row]:
            touching[env, p] = 1
            missed_out[row] = 1

    @wp.kernel(enable_backward=False, module="unique")
    def take(
        which: wp.array(dtype=wp.int32),
        kept: numbers,
        gained: numbers,
        new_traction: vectors,
        new_elastic: vectors,
        new_moved: wp.array2d(dtype=wp.vec3),
        new_gap: numbers,
        new_extra: numbers,
        branches: wp.array3d(dtype=vec3),
        traction_out: vectors,
        elastic_out: vectors,
        moved_out: wp.array2d(dtype=wp.vec3),
        gap_out: numbers,
        extra_out: numbers,
    ):
        row, p = wp.tid()
        env = which[row]
        change = new_elastic[env, p] - elastic_out[env, p]
        for b in range(branches.shape[0]):
            branches[b, env, p] = branches[b, env, p] * kept[row, b] + change * gained[row, b]
        traction_out[env, p] = new_traction[env, p]
        elastic_out[env, p] = new_elastic[env, p]
        moved_out[env, p] = new_moved[env, p]
        gap_out[env, p] = new_gap[env, p]
        extra_out[env, p] = new_extra[env, p]

    @wp.kernel(enable_backward=False, module="unique")
    def measure(
        x: wp.array(dtype=real),
        y: wp.array(dtype=real),
        surface: wp.array(dtype=real),
        local: vec3,
        coefficient: wp.array(dtype=real),
        which: wp.array(dtype=wp.int32),
        tip: wp.array(dtype=wp.vec3d),
        traction: vectors,
        elastic: vectors,
        moved: wp.array2d(dtype=wp.vec3),
        gap: numbers,
        extra: numbers,
        # Out: `READ`
        row_out: wp.array2d(dtype=wp.float64),
    ):
        row, lane = wp.tid()
        env = which[row]
        ny = y.shape[0]
        sums = sums_type()
        maxima = maxima_type()
        for column in range(MAXIMA):
            maxima[column] = -wp.float64(wp.inf)
        for p in range(lane, traction.shape[1], lanes):
            push = wp.vec3d(traction[env, p])
            load = wp.vec3d(elastic[env, p])
            shift = wp.vec3d(moved[env, p])
            given = wp.cw_mul(wp.vec3d(local), load) * wp.float64(extra[env, p])
            sums[6] += wp.dot(load, shift + given)
            maxima[0] = wp.max(maxima[0], shift[2] + given[2] - wp.float64(gap[env, p]))
            if touches(traction[env, p]):
                i, j = p // ny, p % ny
                place = (
                    wp.vec3d(wp.float64(x[i]), wp.float64(y[j]), wp.float64(surface[p]))
                    + shift
                    - tip[row]
                )
                turn = wp.cross(place, push)
                for axis in range(3):
                    sums[axis] += push[axis]
                    sums[3 + axis] += turn[axis]
                sums[7] += wp.float64(1.0)
                maxima[1] = wp.max(maxima[1], -push[2])
                shear = wp.sqrt(push[0] * push[0] + push[1] * push[1])
                maxima[2] = wp.max(maxima[2], shear + wp.float64(coefficient[env]) * push[2])
                maxima[3] = wp.max(maxima[3], -wp.float64(i))
                maxima[4] = wp.max(maxima[4], wp.float64(i))
                maxima[5] = wp.max(maxima[5], -wp.float64(j))
                maxima[6] = wp.max(maxima[6], wp.float64(j))
        if wp.static(lanes > 1):
            for column in range(SUMS):
                sums[column] = wp.tile_sum(wp.tile(sums[column]))[0]
            for column in range(MAXIMA):
                maxima[column] = wp.tile_max(wp.tile(maxima[column]))[0]
        if lane == 0:
            for column in range(SUMS):
                row_out[row, column] = sums[column]
            row_out[row, SUMS] = -maxima[0]
            for column in range(1, MAXIMA):
                row_out[row, SUMS + column] = maxima[column]

    return mark, tally, enlist, recall, spread, displace, take, measure


@functools.cache
def frame_kernels(real):
    """Return the kernels (keep, reach) of what frames keep."""
    vec3 = vector_of(real)
    _side, _pixel, touches, _full = layer_functions(real)

    @wp.kernel(enable_backward=False, module="unique")
    def keep(
        which: wp.array(dtype=wp.int32),
        frame: wp.array(dtype=wp.int32),
        moved: wp.array2d(dtype=wp.vec3),
        traction: wp.array2d(dtype=vec3),
        # Out: frames of displacement [m] and traction [Pa]
        surface_out: wp.array3d(dtype=wp.vec3),
        traction_out: wp.array3d(dtype=wp.vec3),
    ):
        row, p = wp.tid()
        env = which[row]
        push = traction[env, p]
        surface_out[env, frame[row], p] = moved[env, p]
        traction_out[env, frame[row], p] = wp.vec3(float(push[0]), float(push[1]), float(push[2]))

    @wp.func
    def touched(traction: wp.array2d(dtype=vec3), env: int, ny: int, box: wp.vec4i, a: int, b: int):
        """True if sample a, b of the box of touched pixels touches."""
        wide, high = box[1] - box[0] + 1, box[3] - box[2] + 1
        many_x, many_y = FINER * wide + 1, FINER * high + 1
        if a < 0 or b < 0 or a >= many_x or b >= many_y:
            return False
        # The middle of the sample, in pixels.
        i, j = (
            box[0] + (2 * a + 1) * wide // (2 * many_x),
            box[2] + (2 * b + 1) * high // (2 * many_y),
        )
        return touches(traction[env, i * ny + j])

    @wp.kernel(enable_backward=False, module="unique")
    def reach(
        ny: int,
        pixel_x: float,
        pixel_y: float,
        which: wp.array(dtype=wp.int32),
        boxes: wp.array(dtype=wp.vec4i),
        traction: wp.array2d(dtype=vec3),
        # Out: diameter of the largest disc [m]
        width_out: wp.array(dtype=float),
    ):
        row, a, b = wp.tid()
        env = which[row]
        box = boxes[row]
        if not touched(traction, env, ny, box, a, b):
            return
        wide, high = box[1] - box[0] + 1, box[3] - box[2] + 1
        step_x = pixel_x * float(wide) / float(FINER * wide + 1)
        step_y = pixel_y * float(high) / float(FINER * high + 1)
        narrow = wp.min(step_x, step_y)
        best = float(wp.inf)
        ring = int(1)
        while float(ring) * narrow < best:
            ahead = float(ring)
            for side in range(-ring, ring + 1):
                aside = float(side)
                far = wp.length(wp.vec2(ahead * step_x, aside * step_y))
                if far < best:
                    if not touched(traction, env, ny, box, a + ring, b + side):
                        best = far
                    if not touched(traction, env, ny, box, a - ring, b + side):
                        best = far
                far = wp.length(wp.vec2(aside * step_x, ahead * step_y))
                if far < best:
                    if not touched(traction, env, ny, box, a + side, b + ring):
                        best = far
                    if not touched(traction, env, ny, box, a + side, b - ring):
                        best = far
            ring += 1
        # To the middle of a sample outside, half a sample beyond the contact's edge.
        wp.atomic_max(width_out, row, wp.max(2.0 * best - narrow, narrow))

    return keep, reach
