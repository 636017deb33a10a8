# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Contact of a batch of layers, on the pixels that may touch: the same as `sim.layer.contact`.

A press is solved by one thread on a CPU and by one block of threads on a GPU, in one launch. Each
pixel's displacement is summed over all listed pixels: there are a few hundred of them, so that this
takes no longer than Fourier transforms of a window, and needs no window.
"""

import functools

import warp as wp

from sim.layer.contact import DAMPED, DAMPED_MOST, ITERATIONS, SHARE, STALLED, TINY, TURNS
from sim.scalars import vector_of

# Bits of a pixel's place in y; those above are its place in x.
PACKED = 16
LAST = 2**PACKED - 1


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
    pixels = wp.array2d(dtype=wp.int32)
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
    def given(shear: vec2, bound: real):
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
            ny: int,
            table: layers,
            listed: pixels,
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
                    place = listed[env, k]
                    change = move[env, k]
                    moved = change * (extra[env, pixel(place, ny)] * local)
                    for m in range(many):
                        other = move[env, m]
                        if product(other, other) != zero:
                            there = listed[env, m]
                            i = (place >> PACKED) - (there >> PACKED)
                            j = (place & LAST) - (there & LAST)
                            moved += displacement(table, i, j, other)
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
    shear_residual, rub = descent(pairs, within, given, dot, shear_by)

    @wp.func
    def caused(
        env: int,
        k: int,
        many: int,
        ny: int,
        table: layers,
        listed: pixels,
        extra: numbers,
        local: vec3,
        load: wp.array2d(dtype=vec3),
    ):
        """Return the displacement of the k-th pixel by a load on all of them."""
        here = listed[env, k]
        moved = wp.cw_mul(local, load[env, k]) * extra[env, pixel(here, ny)]
        for m in range(many):
            force = load[env, m]
            if touches(force):
                moved += full(table, here, listed[env, m], force, 1)
        return moved

    @wp.kernel(enable_backward=False, module="unique")
    def solve(
        # Layer: displacements by offset, and those of a pixel by its own traction
        ny: int,
        table: layers,
        local: vec3,
        tolerance: real,
        coefficient_of: wp.array(dtype=real),
        # In: presses, their pixels, gaps without any traction, and how the tip has moved
        which: wp.array(dtype=wp.int32),
        count: wp.array(dtype=wp.int32),
        listed: pixels,
        gap_of: numbers,
        extra: numbers,
        factor_of: wp.array(dtype=real),
        travel_of: wp.array(dtype=vec3),
        # In, by the place in the list: traction from the history, and a guess of the traction
        held: wp.array2d(dtype=vec3),
        guess: wp.array2d(dtype=vec3),
        # Scratch
        pressure: numbers,
        gap: numbers,
        move: numbers,
        answer: numbers,
        shear: pairs,
        slip: pairs,
        move2: pairs,
        answer2: pairs,
        before: pairs,
        rested: pairs,
        load: wp.array2d(dtype=vec3),
        # Out: traction, residual and iterations
        traction_out: wp.array2d(dtype=vec3),
        residual_out: wp.array(dtype=real),
        iterations_out: wp.array(dtype=wp.int32),
    ):
        row, lane = wp.tid()
        env = which[row]
        many = count[env]
        factor = factor_of[row]
        coefficient = coefficient_of[env]
        # Without any traction now, nothing touches: there is no contact.
        for k in range(lane, many, lanes):
            load[env, k] = held[env, k]
        least = total(zero)
        for k in range(lane, many, lanes):
            moved = caused(env, k, many, ny, table, listed, extra, local, load)
            away = factor * gap_of[env, pixel(listed[env, k], ny)]
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
            moved = caused(env, k, many, ny, table, listed, extra, local, load)
            away = factor * gap_of[env, pixel(listed[env, k], ny)]
            gap[env, k] = away + moved[2]
            if wp.static(friction):
                slip[env, k] = vec2(
                    -factor * travel_of[row][0] - moved[0], -factor * travel_of[row][1] - moved[1]
                )
        done = int(0)
        residual = zero
        if wp.static(not friction):
            done = push(
                env, lane, many, ny, table, listed, extra, local[2], zero, tolerance,
                pressure, pressure, gap, move, answer,
            )  # fmt: skip
            residual = normal_residual(env, lane, many, local[2], zero, pressure, pressure, gap)
        else:
            # What the guess has more than its own projection is not part of the displacement now.
            total(zero)
            for k in range(lane, many, lanes):
                load[env, k] = guess[env, k] - held[env, k]
            total(zero)
            for k in range(lane, many, lanes):
                moved = caused(env, k, many, ny, table, listed, extra, local, load)
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
                    env, lane, many, ny, table, listed, extra, local[2], zero,
                    wp.max(real(SHARE) * pushing, tolerance / real(2.0)),
                    pressure, pressure, gap, move, answer,
                )  # fmt: skip
                for k in range(lane, many, lanes):
                    bound = coefficient * pressure[env, k]
                    allowed = within(shear[env, k], bound)
                    change = allowed - shear[env, k]
                    # What the pressure has changed by, and the shear that is allowed no more.
                    eased = load[env, k][2] - pressure[env, k]
                    load[env, k] = vec3(change[0], change[1], eased)
                    before[env, k] = shear[env, k]
                    shear[env, k] = allowed
                total(zero)
                for k in range(lane, many, lanes):
                    moved = caused(env, k, many, ny, table, listed, extra, local, load)
                    slip[env, k] = slip[env, k] + vec2(moved[0], moved[1])
                total(zero)
                for k in range(lane, many, lanes):
                    rested[env, k] = slip[env, k]
                    load[env, k] = vec3(shear[env, k][0], shear[env, k][1], zero)
                done += rub(
                    env, lane, many, ny, table, listed, extra, local[0], coefficient,
                    wp.max(real(SHARE) * rubbing, tolerance / real(2.0)),
                    pressure, shear, slip, move2, answer2,
                )  # fmt: skip
                for k in range(lane, many, lanes):
                    old = vec2(load[env, k][0], load[env, k][1])
                    now = old + (shear[env, k] - old) * fraction
                    shear[env, k] = now
                    slip[env, k] = rested[env, k] + (slip[env, k] - rested[env, k]) * fraction
                    change = now - before[env, k]
                    load[env, k] = vec3(change[0], change[1], zero)
                total(zero)
                for k in range(lane, many, lanes):
                    moved = caused(env, k, many, ny, table, listed, extra, local, load)
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
