# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""What elements and faces give, gathered at the nodes; forces that belong to nodes.

Gathering (no atomic adds) makes every sum run in the same order on every device, so that a result
repeats to the last bit. One thread takes a run of `RUN` nodes, whose share of the dot products it
adds up in float64.
"""

import functools

import warp as wp

from sim.fem.scalars import vector_of

SUMS = 10
"""Sums that `residual_kernel` takes, see there."""
RUN = 32
"""Nodes of one thread: long enough to make partial sums few, short enough to fill a GPU."""


@functools.cache
def residual_kernel(real, inertia: bool, gravity: bool):
    """Kernel of what is out of balance, for one precision and combination of effects."""
    vec3 = vector_of(real)

    @wp.kernel(enable_backward=False, module="unique")
    def residual(
        # Mesh:
        node_elements: wp.array2d(dtype=wp.int32),
        node_faces: wp.array2d(dtype=wp.int32),
        free: wp.array(dtype=wp.int32),
        node_mass: wp.array2d(dtype=real),
        variant: wp.array(dtype=wp.int32),
        # Inertia: mass over step squared, by environment, and where the nodes would fly
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
        # Out: what is out of balance, and sums: r.r, applied.applied, -r.direction, least det F,
        # force of the indenter (3), force of the base (3)
        residual_out: wp.array2d(dtype=vec3),
        sums_out: wp.array3d(dtype=wp.float64),
    ):
        env, run = wp.tid()
        if active[env] == 0:
            return
        m = variant[env]
        square = wp.float64(0.0)
        applied_square = wp.float64(0.0)
        slope = wp.float64(0.0)
        lowest = real(1.0e30)
        push = wp.vec3d()
        held = wp.vec3d()
        last = wp.min((run + 1) * RUN, free.shape[0])
        for n in range(run * RUN, last):
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
            push += wp.vec3d(applied)
            if wp.static(gravity):
                applied += weight[env] * node_mass[m, n]
            if wp.static(inertia):
                inner += (u[env, n] - predicted[env, n]) * (inertia_rate[env] * node_mass[m, n])
            if free[n] == 0:
                held += wp.vec3d(inner - applied)
            r = (applied - inner) * real(free[n])
            applied = applied * real(free[n])
            residual_out[env, n] = r
            square += wp.float64(wp.dot(r, r))
            applied_square += wp.float64(wp.dot(applied, applied))
            slope -= wp.float64(wp.dot(r, direction[env, n]))
        sums_out[env, run, 0] = square
        sums_out[env, run, 1] = applied_square
        sums_out[env, run, 2] = slope
        sums_out[env, run, 3] = wp.float64(lowest)
        for axis in range(3):
            sums_out[env, run, 4 + axis] = push[axis]
            sums_out[env, run, 7 + axis] = held[axis]

    return residual


@functools.cache
def push_kernel(real):
    """Kernel of the forces that faces give to nodes that move, in place of a residual."""
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
def reduce_kernel():
    """Kernel that adds the sums (B, runs, `SUMS`) of each environment up; least of column 3."""

    @wp.kernel(enable_backward=False, module="unique")
    def reduce(
        # In:
        active: wp.array(dtype=wp.int32),
        sums: wp.array3d(dtype=wp.float64),
        # Out:
        totals_out: wp.array2d(dtype=wp.float64),
    ):
        env, which = wp.tid()
        if active[env] == 0:
            return
        total = wp.float64(0.0)
        if which == 3:
            total = wp.float64(1.0e30)
        for run in range(sums.shape[1]):
            if which == 3:
                total = wp.min(total, sums[env, run, which])
            else:
                total += sums[env, run, which]
        totals_out[env, which] = total

    return reduce
