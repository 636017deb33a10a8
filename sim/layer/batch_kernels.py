# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Kernels of a batch of layers: contact on the pixels that may touch, as by `sim.layer.contact`.

A press is solved by one thread on a CPU and by one block of threads on a GPU, in one launch. Each
pixel's displacement is summed over all listed pixels: there are a few hundred of them, so that this
takes no longer than Fourier transforms of a window, and needs no window.
"""

import functools

import numpy as np
import warp as wp

from sim.layer.contact import DAMPED, DAMPED_MOST, ITERATIONS, SHARE, STALLED, TINY, TURNS
from sim.scalars import vector_of

# Bits of a pixel's place in y; those above are its place in x.
PACKED = 16
LAST = 2**PACKED - 1


@functools.cache
def layer_struct(real):
    """Return the struct of the layer: displacements by offset, and the pixels that may touch."""

    class LayerTable:
        ny: int  # pixels along y
        table: wp.array3d(dtype=real)  # as `layer_functions` reads it
        local: vector_of(real)  # displacement of a pixel by its own traction of 1 Pa
        coefficient: wp.array(dtype=real)  # of friction (B,)
        count: wp.array(dtype=wp.int32)  # listed pixels (B,), and their packed places
        listed: wp.array2d(dtype=wp.int32)

    return wp.struct(LayerTable)


@functools.cache
def step_struct(real):
    """Return the struct of a step: its presses (N,), and how their layers relax."""

    class LayerStep:
        which: wp.array(dtype=wp.int32)
        factor: wp.array(dtype=real)
        decay: wp.array2d(dtype=real)  # by branch (N, branches)
        gained: wp.array2d(dtype=real)

    return wp.struct(LayerStep)


@functools.cache
def fields_struct(real):
    """Return the struct of the state of all pixels (B, P)."""
    vec3 = vector_of(real)

    class Fields:
        traction: wp.array2d(dtype=vec3)
        elastic: wp.array2d(dtype=vec3)
        moved: wp.array2d(dtype=wp.vec3)
        gap: wp.array2d(dtype=real)
        extra: wp.array2d(dtype=real)

    return wp.struct(Fields)


@functools.cache
def scratch_struct(real):
    """Return the struct of what a solve needs by place in the list (B, P); pairs with friction."""
    vec2 = wp.types.vector(length=2, dtype=real)

    class Scratch:
        pressure: wp.array2d(dtype=real)
        gap: wp.array2d(dtype=real)
        move: wp.array2d(dtype=real)
        answer: wp.array2d(dtype=real)
        shear: wp.array2d(dtype=vec2)
        slip: wp.array2d(dtype=vec2)
        move2: wp.array2d(dtype=vec2)
        answer2: wp.array2d(dtype=vec2)
        before: wp.array2d(dtype=vec2)
        rested: wp.array2d(dtype=vec2)
        load: wp.array2d(dtype=vector_of(real))

    return wp.struct(Scratch)


@functools.cache
def layer_functions(real):
    """Return the functions (side, pixel, touches, full) of packed places and tractions.

    `full` reads a table of displacements (6, nx, ny) by offset. Its rows are those of
    `Grid.symbol`, the displacement of a pixel by a traction of 1 Pa on another one that is (i, j)
    pixels before it [m/Pa].
    """
    vec3 = vector_of(real)
    zero = real(0.0)

    @wp.func
    def side(distance: int):
        if distance > 0:
            return real(1.0)
        if distance < 0:
            return real(-1.0)
        return zero

    @wp.func
    def pixel(place: int, ny: int):
        """Return the number of the pixel at a packed place."""
        return (place >> PACKED) * ny + (place & LAST)

    @wp.func
    def touches(push: vec3):
        return push[0] != zero or push[1] != zero or push[2] != zero

    @wp.func
    def full(table: wp.array3d(dtype=real), here: int, there: int, push: vec3, shear: int):
        """Return the displacement of the pixel at `here` by the traction `push` at `there`."""
        i, j = (here >> PACKED) - (there >> PACKED), (here & LAST) - (there & LAST)
        a, b = wp.abs(i), wp.abs(j)
        east, north = side(i), side(j)
        xz, yz = table[4, a, b] * east, table[5, a, b] * north
        moved = vec3(xz * push[2], yz * push[2], table[2, a, b] * push[2])
        if shear > 0:
            xy = table[3, a, b] * east * north
            moved[0] += table[0, a, b] * push[0] + xy * push[1]
            moved[1] += xy * push[0] + table[1, a, b] * push[1]
            moved[2] -= xz * push[0] + yz * push[1]
        return moved

    return side, pixel, touches, full


@functools.cache
def contact_kernel(real, friction: bool, lanes: int):
    """Return the kernel that solves each press; `lanes` threads work at one: 1, or a whole block.

    Every sum over the lanes is also the barrier after which they read what the others have written.
    """
    vec2 = wp.types.vector(length=2, dtype=real)
    vec3 = vector_of(real)
    side, pixel, touches, full = layer_functions(real)
    zero, one, tiny = real(0.0), real(1.0), real(TINY)
    layer_type = layer_struct(real)
    numbers = wp.array2d(dtype=real)
    pairs = wp.array2d(dtype=vec2)
    layers = wp.array3d(dtype=real)

    @wp.func
    def total(value: real):
        return value

    @wp.func
    def lowest(value: real):
        return value

    if lanes > 1:

        @wp.func
        def total(value: real):
            return wp.tile_sum(wp.tile(value))[0]

        @wp.func
        def lowest(value: real):
            return wp.tile_min(wp.tile(value))[0]

    @wp.func
    def within(shear: vec2, bound: real):
        return shear * (bound / wp.max(wp.max(wp.length(shear), bound), tiny))

    @wp.func
    def pushes(pressure: real, bound: real):
        return wp.max(pressure, zero)

    @wp.func
    def pressed(pressure: real, bound: real):
        return pressure

    @wp.func
    def coulomb_limit(shear: vec2, bound: real):
        return bound

    @wp.func
    def times(one: real, other: real):
        return one * other

    @wp.func
    def dot(one: vec2, other: vec2):
        return wp.dot(one, other)

    @wp.func
    def normal_by(table: layers, i: int, j: int, pressure: real):
        return table[2, wp.abs(i), wp.abs(j)] * pressure

    @wp.func
    def shear_by(table: layers, i: int, j: int, shear: vec2):
        a, b = wp.abs(i), wp.abs(j)
        xy = table[3, a, b] * side(i) * side(j)
        return vec2(
            table[0, a, b] * shear[0] + xy * shear[1], xy * shear[0] + table[1, a, b] * shear[1]
        )

    def descent(unknowns, project, scale, product, displacement):
        """Return the functions (residual, descend) of one unknown, as in `sim.layer.contact`."""

        @wp.func
        def residual(
            env: int,
            lane: int,
            many: int,
            local: real,
            coefficient: real,
            pressure: numbers,
            x: unknowns,
            slope: unknowns,
        ):
            distance2 = zero
            scale2 = zero
            for k in range(lane, many, lanes):
                bound = coefficient * pressure[env, k]
                here = x[env, k]
                off = here - project(here - slope[env, k] / local, bound)
                size = scale(here, bound)
                distance2 += product(off, off)
                scale2 += size * size
            distance = wp.sqrt(total(distance2))
            largest = wp.max(wp.sqrt(total(scale2)), distance)
            if distance > zero:
                return distance / largest
            return zero

        @wp.func
        def descend(
            env: int,
            lane: int,
            many: int,
            layer: layer_type,
            extra: numbers,
            local: real,
            coefficient: real,
            tolerance: real,
            pressure: numbers,
            # In and out: the unknown, and the gap or slip that it leaves
            x: unknowns,
            slope: unknowns,
            # Scratch
            move: unknowns,
            answer: unknowns,
        ):
            """Minimise over the unknown; return the iterations."""
            step = one / local
            done = int(0)
            left = residual(env, lane, many, local, coefficient, pressure, x, slope)
            while left > tolerance and done < ITERATIONS:
                done += 1
                length = zero
                for k in range(lane, many, lanes):
                    here = x[env, k]
                    bound = coefficient * pressure[env, k]
                    change = project(here - slope[env, k] * step, bound) - here
                    move[env, k] = change
                    length += product(change, change)
                length = total(length)
                curvature = zero
                size = zero
                along = zero
                for k in range(lane, many, lanes):
                    place = layer.listed[env, k]
                    change = move[env, k]
                    moved = change * (extra[env, pixel(place, layer.ny)] * local)
                    for m in range(many):
                        other = move[env, m]
                        if product(other, other) != zero:
                            there = layer.listed[env, m]
                            i = (place >> PACKED) - (there >> PACKED)
                            j = (place & LAST) - (there & LAST)
                            moved += displacement(layer.table, i, j, other)
                    answer[env, k] = moved
                    curvature += product(change, moved)
                    size += product(moved, moved)
                    along += product(slope[env, k], change)
                curvature = total(curvature)
                size = total(size)
                along = total(along)
                if not (curvature > zero and size > zero):
                    break
                fraction = wp.min(one, -along / curvature)
                for k in range(lane, many, lanes):
                    x[env, k] = x[env, k] + move[env, k] * fraction
                    slope[env, k] = slope[env, k] + answer[env, k] * fraction
                step = length / curvature
                if done % 2 == 0:
                    step = curvature / size
                left = residual(env, lane, many, local, coefficient, pressure, x, slope)
            return done

        return residual, descend

    normal_residual, push = descent(numbers, pushes, pressed, times, normal_by)
    shear_residual, rub = descent(pairs, within, coulomb_limit, dot, shear_by)

    @wp.func
    def caused(
        env: int, k: int, many: int, layer: layer_type, extra: numbers, load: wp.array2d(dtype=vec3)
    ):
        """Return the displacement of the k-th pixel by a load on all of them."""
        here = layer.listed[env, k]
        moved = wp.cw_mul(layer.local, load[env, k]) * extra[env, pixel(here, layer.ny)]
        for m in range(many):
            force = load[env, m]
            if touches(force):
                moved += full(layer.table, here, layer.listed[env, m], force, 1)
        return moved

    @wp.kernel(enable_backward=False, module="unique")
    def solve(
        layer: layer_type,
        tolerance: real,
        # In: presses, gaps without any traction, and how the tip has moved
        step: step_struct(real),
        ahead: fields_struct(real),
        travel_of: wp.array(dtype=vec3),
        # In, by the place in the list: traction from the history, and a guess of the traction
        held: wp.array2d(dtype=vec3),
        guess: wp.array2d(dtype=vec3),
        scratch: scratch_struct(real),
        # Out: traction, residual and iterations
        traction_out: wp.array2d(dtype=vec3),
        residual_out: wp.array(dtype=real),
        iterations_out: wp.array(dtype=wp.int32),
    ):
        row, lane = wp.tid()
        env = step.which[row]
        many = layer.count[env]
        factor = step.factor[row]
        coefficient = layer.coefficient[env]
        extra = ahead.extra
        local = layer.local
        rested = scratch.rested
        pressure = scratch.pressure
        gap = scratch.gap
        shear = scratch.shear
        slip = scratch.slip
        load = scratch.load
        # Without any traction now, nothing touches: there is no contact.
        for k in range(lane, many, lanes):
            load[env, k] = held[env, k]
        least = total(zero)
        for k in range(lane, many, lanes):
            moved = caused(env, k, many, layer, extra, load)
            away = factor * ahead.gap[env, pixel(layer.listed[env, k], layer.ny)]
            least = wp.min(least, away + moved[2])
        if lowest(least) >= zero:
            for k in range(lane, many, lanes):
                traction_out[env, k] = vec3()
            if lane == 0:
                residual_out[env] = zero
                iterations_out[env] = 0
            return
        # A guess within the limits, and the load that makes the gap and slip it leaves.
        for k in range(lane, many, lanes):
            first = guess[env, k]
            pressure[env, k] = wp.max(-first[2], zero)
            inside = vec2(zero, zero)
            if wp.static(friction):
                inside = within(vec2(first[0], first[1]), coefficient * pressure[env, k])
                shear[env, k] = inside
            load[env, k] = held[env, k] - vec3(inside[0], inside[1], -pressure[env, k])
        total(zero)
        for k in range(lane, many, lanes):
            moved = caused(env, k, many, layer, extra, load)
            away = factor * ahead.gap[env, pixel(layer.listed[env, k], layer.ny)]
            gap[env, k] = away + moved[2]
            if wp.static(friction):
                slip[env, k] = vec2(
                    -factor * travel_of[row][0] - moved[0], -factor * travel_of[row][1] - moved[1]
                )
        done = int(0)
        residual = zero
        if wp.static(not friction):
            done = push(
                env, lane, many, layer, extra, local[2], zero, tolerance,
                pressure, pressure, gap, scratch.move, scratch.answer,
            )  # fmt: skip
            residual = normal_residual(env, lane, many, local[2], zero, pressure, pressure, gap)
        else:
            # The guess less its own projection is not part of the displacement now.
            total(zero)
            for k in range(lane, many, lanes):
                load[env, k] = guess[env, k] - held[env, k]
            total(zero)
            for k in range(lane, many, lanes):
                moved = caused(env, k, many, layer, extra, load)
                slip[env, k] = slip[env, k] - vec2(moved[0], moved[1])
            fraction = real(one)
            last = real(wp.inf)
            turn = int(0)
            while turn < TURNS:
                turn += 1
                pushing = normal_residual(env, lane, many, local[2], zero, pressure, pressure, gap)
                rubbing = shear_residual(
                    env, lane, many, local[0], coefficient, pressure, shear, slip
                )
                residual = wp.max(pushing, rubbing)
                if residual <= tolerance:
                    break
                if residual > real(STALLED) * last:
                    fraction = wp.max(real(DAMPED) * fraction, real(DAMPED_MOST))
                last = residual
                for k in range(lane, many, lanes):
                    load[env, k] = vec3(zero, zero, pressure[env, k])
                done += push(
                    env, lane, many, layer, extra, local[2], zero,
                    wp.max(real(SHARE) * pushing, tolerance / real(2.0)),
                    pressure, pressure, gap, scratch.move, scratch.answer,
                )  # fmt: skip
                for k in range(lane, many, lanes):
                    bound = coefficient * pressure[env, k]
                    allowed = within(shear[env, k], bound)
                    change = allowed - shear[env, k]
                    # What the pressure has changed by, and the shear that is allowed no more.
                    eased = load[env, k][2] - pressure[env, k]
                    load[env, k] = vec3(change[0], change[1], eased)
                    scratch.before[env, k] = shear[env, k]
                    shear[env, k] = allowed
                total(zero)
                for k in range(lane, many, lanes):
                    moved = caused(env, k, many, layer, extra, load)
                    slip[env, k] = slip[env, k] + vec2(moved[0], moved[1])
                total(zero)
                for k in range(lane, many, lanes):
                    rested[env, k] = slip[env, k]
                    load[env, k] = vec3(shear[env, k][0], shear[env, k][1], zero)
                done += rub(
                    env, lane, many, layer, extra, local[0], coefficient,
                    wp.max(real(SHARE) * rubbing, tolerance / real(2.0)),
                    pressure, shear, slip, scratch.move2, scratch.answer2,
                )  # fmt: skip
                for k in range(lane, many, lanes):
                    old = vec2(load[env, k][0], load[env, k][1])
                    now = old + (shear[env, k] - old) * fraction
                    shear[env, k] = now
                    slip[env, k] = rested[env, k] + (slip[env, k] - rested[env, k]) * fraction
                    change = now - scratch.before[env, k]
                    load[env, k] = vec3(change[0], change[1], zero)
                total(zero)
                for k in range(lane, many, lanes):
                    moved = caused(env, k, many, layer, extra, load)
                    gap[env, k] = gap[env, k] - moved[2]
                total(zero)
        for k in range(lane, many, lanes):
            traction = vec3(zero, zero, -pressure[env, k])
            if wp.static(friction):
                traction[0] = shear[env, k][0]
                traction[1] = shear[env, k][1]
            traction_out[env, k] = traction
        if lane == 0:
            residual_out[env] = residual
            iterations_out[env] = done

    return solve


# State: the pixels that touch, steps, and stored frames.

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
    vectors, whole = wp.array2d(dtype=vec3), wp.array2d(dtype=wp.int32)
    layer_type, step_type, fields_type = layer_struct(real), step_struct(real), fields_struct(real)
    sums_type = wp.types.vector(length=SUMS, dtype=wp.float64)
    maxima_type = wp.types.vector(length=MAXIMA, dtype=wp.float64)

    @wp.kernel(enable_backward=False, module="unique")
    def mark(
        bulge: real,
        step: step_type,
        ahead: fields_type,
        now: fields_type,
        least: wp.array(dtype=real),
        # Out: 1 for pixels that may touch
        touching_out: whole,
    ):
        row, p = wp.tid()
        env = step.which[row]
        near = ahead.gap[env, p] < bulge * wp.max(real(0.0), -least[env])
        touching_out[env, p] = wp.where(near or touches(now.elastic[env, p]), 1, 0)

    @wp.kernel(enable_backward=False, module="unique")
    def tally(layer: layer_type, step: step_type, touching: whole, tally_out: whole):
        row, i = wp.tid()
        env = step.which[row]
        count = int(0)
        for j in range(layer.ny):
            count += touching[env, i * layer.ny + j]
        tally_out[env, i] = count

    @wp.kernel(enable_backward=False, module="unique")
    def enlist(
        # Out: packed places in order, and their number
        layer: layer_type,
        # In:
        step: step_type,
        touching: whole,
        tally: whole,
    ):
        row, i = wp.tid()
        env = step.which[row]
        place = int(0)
        for before in range(i):
            place += tally[env, before]
        for j in range(layer.ny):
            if touching[env, i * layer.ny + j] > 0:
                layer.listed[env, place] = (i << PACKED) + j
                place += 1
        if i == tally.shape[1] - 1:
            layer.count[env] = place

    @wp.kernel(enable_backward=False, module="unique")
    def recall(
        layer: layer_type,
        step: step_type,
        elastic: vectors,
        branches: wp.array3d(dtype=vec3),
        # Out, by the place in the list: traction from the history, and with the displacement as is
        held_out: vectors,
        guess_out: vectors,
        # Out, by pixel: no traction yet
        ahead: fields_type,
    ):
        row, k = wp.tid()
        env = step.which[row]
        ahead.traction[env, k] = vec3()
        ahead.elastic[env, k] = vec3()
        if k >= layer.count[env]:
            return
        p = pixel(layer.listed[env, k], layer.ny)
        held = vec3()
        for b in range(branches.shape[0]):
            held += branches[b, env, p] * step.decay[row, b] - elastic[env, p] * step.gained[row, b]
        held_out[env, k] = held
        guess_out[env, k] = elastic[env, p] * step.factor[row] + held

    @wp.kernel(enable_backward=False, module="unique")
    def spread(
        layer: layer_type,
        step: step_type,
        held: vectors,
        traction: vectors,
        # Out: by pixel, and the elastic part by the place in the list
        ahead: fields_type,
        load_out: vectors,
    ):
        row, k = wp.tid()
        env = step.which[row]
        if k >= layer.count[env]:
            return
        p = pixel(layer.listed[env, k], layer.ny)
        elastic = (traction[env, k] - held[env, k]) / step.factor[row]
        ahead.traction[env, p] = traction[env, k]
        ahead.elastic[env, p] = elastic
        load_out[env, k] = elastic

    @wp.kernel(enable_backward=False, module="unique")
    def displace(
        layer: layer_type,
        step: step_type,
        load: vectors,
        allowed: wp.array(dtype=real),
        # Out: displacement [m]
        ahead: fields_type,
        # In and out: pixels that may touch; overlap beyond `allowed` adds one, `missed_out` says so
        touching: whole,
        missed_out: wp.array(dtype=wp.int32),
    ):
        row, p = wp.tid()
        env = step.which[row]
        here = ((p // layer.ny) << PACKED) + p % layer.ny
        moved = vec3()
        for m in range(layer.count[env]):
            there = layer.listed[env, m]
            moved += full(layer.table, here, there, load[env, m], wp.static(int(friction)))
        ahead.moved[env, p] = wp.vec3(float(moved[0]), float(moved[1]), float(moved[2]))
        if touching[env, p] == 0 and ahead.gap[env, p] - moved[2] < -allowed[row]:
            touching[env, p] = 1
            missed_out[row] = 1

    @wp.kernel(enable_backward=False, module="unique")
    def take(
        step: step_type,
        ahead: fields_type,
        # In and out:
        branches: wp.array3d(dtype=vec3),
        now: fields_type,
    ):
        row, p = wp.tid()
        env = step.which[row]
        change = ahead.elastic[env, p] - now.elastic[env, p]
        for b in range(branches.shape[0]):
            branches[b, env, p] = (
                branches[b, env, p] * step.decay[row, b] + change * step.gained[row, b]
            )
        now.traction[env, p] = ahead.traction[env, p]
        now.elastic[env, p] = ahead.elastic[env, p]
        now.moved[env, p] = ahead.moved[env, p]
        now.gap[env, p] = ahead.gap[env, p]
        now.extra[env, p] = ahead.extra[env, p]

    @wp.kernel(enable_backward=False, module="unique")
    def measure(
        x: wp.array(dtype=real),
        y: wp.array(dtype=real),
        surface: wp.array(dtype=real),
        layer: layer_type,
        which: wp.array(dtype=wp.int32),
        tip: wp.array(dtype=wp.vec3d),
        now: fields_type,
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
        for p in range(lane, now.traction.shape[1], lanes):
            push = wp.vec3d(now.traction[env, p])
            load = wp.vec3d(now.elastic[env, p])
            shift = wp.vec3d(now.moved[env, p])
            yielded = wp.cw_mul(wp.vec3d(layer.local), load) * wp.float64(now.extra[env, p])
            sums[6] += wp.dot(load, shift + yielded)
            maxima[0] = wp.max(maxima[0], shift[2] + yielded[2] - wp.float64(now.gap[env, p]))
            if touches(now.traction[env, p]):
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
                maxima[2] = wp.max(maxima[2], shear + wp.float64(layer.coefficient[env]) * push[2])
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
        now: fields_struct(real),
        # Out: frames of displacement [m] and traction [Pa]
        surface_out: wp.array3d(dtype=wp.vec3),
        traction_out: wp.array3d(dtype=wp.vec3),
    ):
        row, p = wp.tid()
        env = which[row]
        push = now.traction[env, p]
        surface_out[env, frame[row], p] = now.moved[env, p]
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
