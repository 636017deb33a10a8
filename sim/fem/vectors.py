# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Vector operations on a batch, and the residual at its nodes."""

import functools

import warp as wp

from sim.scalars import vector_of


@functools.cache
def _copy_kernel(dtype, dimensions):
    array = {2: wp.array2d, 3: wp.array3d}[dimensions]

    @wp.kernel(enable_backward=False, module="unique")
    def copy_rows(
        # In:
        active: wp.array(dtype=wp.int32),
        source: array(dtype=dtype),
        # Out:
        copy_out: array(dtype=dtype),
    ):
        env, i = wp.tid()
        if active[env] == 0:
            return
        if wp.static(dimensions == 2):
            copy_out[env, i] = source[env, i]
        else:
            for j in range(source.shape[2]):
                copy_out[env, i, j] = source[env, i, j]

    return copy_rows


def copy_active(active, source, out) -> None:
    """Copy the rows of active environments, arrays of (B, n) or (B, n, m)."""
    wp.launch(
        _copy_kernel(source.dtype, source.ndim),
        dim=source.shape[:2],
        inputs=[active, source],
        outputs=[out],
        device=source.device,
    )


@functools.cache
def _fill_kernel(vec3):
    @wp.kernel(enable_backward=False, module="unique")
    def fill(
        # In:
        active: wp.array(dtype=wp.int32),
        value: wp.array(dtype=vec3),
        # Out:
        field_out: wp.array2d(dtype=vec3),
    ):
        env, n = wp.tid()
        if active[env] == 0:
            return
        field_out[env, n] = value[env]

    return fill


def fill(active, value, out) -> None:
    """Write the vector `value` of each active environment (B,) everywhere in its row (B, N)."""
    wp.launch(
        _fill_kernel(out.dtype),
        dim=out.shape,
        inputs=[active, value],
        outputs=[out],
        device=out.device,
    )


@functools.cache
def _extrapolate_kernel(real, vec3):
    @wp.kernel(enable_backward=False, module="unique")
    def extrapolate(
        # In:
        active: wp.array(dtype=wp.int32),
        fraction: wp.array(dtype=real),
        now: wp.array2d(dtype=vec3),
        before: wp.array2d(dtype=vec3),
        # Out:
        guess_out: wp.array2d(dtype=vec3),
    ):
        env, n = wp.tid()
        if active[env] == 0:
            return
        guess_out[env, n] = now[env, n] + (now[env, n] - before[env, n]) * fraction[env]

    return extrapolate


def extrapolate(active, fraction, now, before, out) -> None:
    """Write out = now + fraction * (now - before) where active; vectors (B, N), fraction (B,)."""
    wp.launch(
        _extrapolate_kernel(fraction.dtype, now.dtype),
        dim=now.shape,
        inputs=[active, fraction, now, before],
        outputs=[out],
        device=now.device,
    )


@functools.cache
def _walk_kernel(real, vec3):
    @wp.kernel(enable_backward=False, module="unique")
    def axpy(
        # In:
        active: wp.array(dtype=wp.int32),
        length: wp.array(dtype=real),
        start: wp.array2d(dtype=vec3),
        direction: wp.array2d(dtype=vec3),
        # Out:
        u_out: wp.array2d(dtype=vec3),
    ):
        env, n = wp.tid()
        if active[env] == 0:
            return
        u_out[env, n] = start[env, n] + direction[env, n] * length[env]

    return axpy


def axpy(active, length, start, direction, out) -> None:
    """Write out = start + length * direction where active; vectors (B, N), length (B,)."""
    wp.launch(
        _walk_kernel(length.dtype, start.dtype),
        dim=start.shape,
        inputs=[active, length, start, direction],
        outputs=[out],
        device=start.device,
    )


@functools.cache
def _blend_kernel(real):
    @wp.kernel(enable_backward=False, module="unique")
    def blend(
        # In:
        active: wp.array(dtype=wp.int32),
        fraction: real,
        source: wp.array3d(dtype=real),
        # In and out:
        mean_out: wp.array3d(dtype=real),
    ):
        env, i = wp.tid()
        if active[env] == 0:
            return
        for j in range(source.shape[2]):
            mean_out[env, i, j] = mean_out[env, i, j] + fraction * (
                source[env, i, j] - mean_out[env, i, j]
            )

    return blend


def blend(active, fraction: float, source, mean) -> None:
    """Move `mean` by `fraction` of the way to `source` where active; numbers (B, n, m)."""
    wp.launch(
        _blend_kernel(source.dtype),
        dim=source.shape[:2],
        inputs=[active, fraction, source],
        outputs=[mean],
        device=source.device,
    )


# Forces of elements and faces gathered at the nodes, with forces that act on nodes.
#
# Gathering (no atomic adds) makes every sum run in the same order, so that a result is repeatable
# to the last bit. Sums are float64. On a CPU one thread handles `RUN` nodes and adds up its part;
# on a GPU each handles one, and a block of `LANES` threads adds up theirs.

# Number of sums that `residual_kernel` writes, see there; and the one that is a least value.
SUMS, LEAST = 10, 3
# Nodes of a partial sum: on a CPU, and on a GPU.
RUN, LANES = 32, 128


@functools.cache
def residual_kernel(real, inertia: bool, gravity: bool, *, lanes: int = 1):
    """Return the kernel of the residual, for one precision and combination of effects.

    `lanes` threads add up a partial sum: 1, or a whole block.
    """
    vec3 = vector_of(real)
    own = RUN if lanes == 1 else 1
    sums_type = wp.types.vector(length=SUMS, dtype=wp.float64)

    @wp.kernel(enable_backward=False, module="unique")
    def residual(
        # Mesh:
        node_elements: wp.array2d(dtype=wp.int32),
        node_faces: wp.array2d(dtype=wp.int32),
        free: wp.array(dtype=wp.int32),
        node_mass: wp.array2d(dtype=real),
        variant: wp.array(dtype=wp.int32),
        # Inertia: mass over step squared, by environment, and positions of nodes without forces
        inertia_rate: wp.array(dtype=real),
        predicted: wp.array2d(dtype=vec3),
        # Gravity: weight of a unit volume, by environment
        weight: wp.array(dtype=vec3),
        # In:
        active: wp.array(dtype=wp.int32),
        element_force: wp.array3d(dtype=vec3),
        element_det: wp.array2d(dtype=real),
        touched: wp.array2d(dtype=wp.int32),
        face_force: wp.array3d(dtype=vec3),
        u: wp.array2d(dtype=vec3),
        direction: wp.array2d(dtype=vec3),
        # Out: residual, and sums: r.r, applied.applied, -r.direction, least det F,
        # force of the indenter (3), force of the base (3)
        residual_out: wp.array2d(dtype=vec3),
        sums_out: wp.array3d(dtype=wp.float64),
    ):
        env, item = wp.tid()
        if active[env] == 0:
            return
        m = variant[env]
        sums = sums_type()
        lowest = real(1.0e30)
        for n in range(item * own, wp.min((item + 1) * own, free.shape[0])):
            inner = vec3()
            applied = vec3()
            for k in range(8):
                place = node_elements[n, k]
                if place >= 0:
                    inner += element_force[env, place // 8, place % 8]
                    lowest = wp.min(lowest, element_det[env, place // 8])
            for k in range(4):
                place = node_faces[n, k]
                if place >= 0:
                    if touched[env, place // 4] > 0:
                        applied += face_force[env, place // 4, place % 4]
            for axis in range(3):
                sums[4 + axis] += wp.float64(applied[axis])
            if wp.static(gravity):
                applied += weight[env] * node_mass[m, n]
            if wp.static(inertia):
                inner += (u[env, n] - predicted[env, n]) * (inertia_rate[env] * node_mass[m, n])
            if free[n] == 0:
                for axis in range(3):
                    sums[7 + axis] += wp.float64(inner[axis] - applied[axis])
            r = (applied - inner) * real(free[n])
            applied = applied * real(free[n])
            residual_out[env, n] = r
            sums[0] += wp.float64(wp.dot(r, r))
            sums[1] += wp.float64(wp.dot(applied, applied))
            sums[2] -= wp.float64(wp.dot(r, direction[env, n]))
        sums[LEAST] = wp.float64(lowest)
        if wp.static(lanes > 1):
            for which in range(SUMS):
                if which == LEAST:
                    sums[which] = wp.tile_min(wp.tile(sums[which]))[0]
                else:
                    sums[which] = wp.tile_sum(wp.tile(sums[which]))[0]
        if item % lanes == 0:
            for which in range(SUMS):
                sums_out[env, item // lanes, which] = sums[which]

    return residual


@functools.cache
def push_kernel(real):
    """Return the kernel that writes the faces' forces on moving nodes in place of a residual."""
    vec3 = vector_of(real)

    @wp.kernel(enable_backward=False, module="unique")
    def push(
        # Mesh:
        node_faces: wp.array2d(dtype=wp.int32),
        free: wp.array(dtype=wp.int32),
        # In:
        active: wp.array(dtype=wp.int32),
        touched: wp.array2d(dtype=wp.int32),
        face_force: wp.array3d(dtype=vec3),
        # Out:
        residual_out: wp.array2d(dtype=vec3),
    ):
        env, n = wp.tid()
        if active[env] == 0:
            return
        total = vec3()
        for k in range(4):
            place = node_faces[n, k]
            if place >= 0:
                if touched[env, place // 4] > 0:
                    total += face_force[env, place // 4, place % 4]
        residual_out[env, n] = total * real(free[n])

    return push


@functools.cache
def work_kernel(real, friction: bool):
    """Return the kernel of the work at each face's contact points over a step (trapezoid rule).

    Pressure works over the displacement of the skin, friction over that of the indenter: a point
    that comes into contact within the step was not pushed before.
    """
    vec3 = vector_of(real)

    @wp.kernel(enable_backward=False, module="unique")
    def work(
        # Mesh:
        faces: wp.array2d(dtype=wp.int32),
        face_area: wp.array2d(dtype=real),
        shape: wp.array2d(dtype=real),
        rule: wp.array(dtype=real),
        variant: wp.array(dtype=wp.int32),
        # In: displacement and motion of the tip
        active: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
        u_old: wp.array2d(dtype=vec3),
        step: wp.array(dtype=vec3),
        pressure: wp.array3d(dtype=real),
        normal: wp.array3d(dtype=vec3),
        traction: wp.array3d(dtype=vec3),
        traction_old: wp.array3d(dtype=vec3),
        # In and out: pressure as a vector, at the start of the step and at its end
        push_out: wp.array3d(dtype=vec3),
        # Out:
        work_out: wp.array2d(dtype=real),
    ):
        env, s = wp.tid()
        if active[env] == 0:
            return
        total = real(0.0)
        for p in range(rule.shape[0]):
            way = vec3()
            for k in range(4):
                n = faces[s, k]
                way += (u[env, n] - u_old[env, n]) * shape[p, k]
            push = normal[env, s, p] * pressure[env, s, p]
            given = wp.dot(push_out[env, s, p] + push, way)
            if wp.static(friction):
                given += wp.dot(traction[env, s, p] + traction_old[env, s, p], step[env])
            push_out[env, s, p] = push
            total += given * rule[p]
        work_out[env, s] = total * face_area[variant[env], s] * real(0.5)

    return work


@functools.cache
def reduce_kernel(*, lanes: int = 1):
    """Return the kernel that sums (B, runs, `SUMS`) per environment.

    Column `LEAST` takes the least value. `lanes` is as in `residual_kernel`.
    """

    @wp.kernel(enable_backward=False, module="unique")
    def reduce(
        # In:
        active: wp.array(dtype=wp.int32),
        sums: wp.array3d(dtype=wp.float64),
        # Out:
        totals_out: wp.array2d(dtype=wp.float64),
    ):
        env, which, lane = wp.tid()
        if active[env] == 0:
            return
        total = wp.float64(0.0)
        if which == LEAST:
            total = wp.float64(1.0e30)
        for run in range(lane, sums.shape[1], lanes):
            if which == LEAST:
                total = wp.min(total, sums[env, run, which])
            else:
                total += sums[env, run, which]
        if wp.static(lanes > 1):
            if which == LEAST:
                total = wp.tile_min(wp.tile(total))[0]
            else:
                total = wp.tile_sum(wp.tile(total))[0]
        if lane == 0:
            totals_out[env, which] = total

    return reduce
