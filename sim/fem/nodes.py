# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""What elements and faces give, gathered at the nodes; forces that belong to nodes; block Jacobi.

Gathering (no atomic adds) makes every sum run in the same order on every device, so that a result
repeats to the last bit. One thread takes a run of `RUN` nodes, whose share of the dot products it
adds up in float64.
"""

import functools

import warp as wp

from sim.fem.scalars import matrix_of, vector_of

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
        node_mass: wp.array(dtype=real),
        # Inertia: mass over step squared, by environment, and where the nodes would fly
        inertia_rate: wp.array(dtype=real),
        predicted: wp.array2d(dtype=vec3),
        # Gravity: weight of a unit volume, by environment
        weight: wp.array(dtype=vec3),
        # In:
        active: wp.array(dtype=wp.int32),
        element_force: wp.array3d(dtype=vec3),
        touched: wp.array2d(dtype=wp.int32),
        face_force: wp.array3d(dtype=vec3),
        u: wp.array2d(dtype=vec3),
        direction: wp.array2d(dtype=vec3),
        # Out: what is out of balance, and partial sums: r.r, applied.applied, -r.direction
        residual_out: wp.array2d(dtype=vec3),
        sums_out: wp.array3d(dtype=wp.float64),
    ):
        env, run = wp.tid()
        if active[env] == 0:
            return
        square = wp.float64(0.0)
        applied_square = wp.float64(0.0)
        slope = wp.float64(0.0)
        last = wp.min((run + 1) * RUN, free.shape[0])
        for n in range(run * RUN, last):
            inner = vec3()
            applied = vec3()
            for k in range(8):
                place = node_elements[n, k]
                if place >= 0:
                    inner += element_force[env, place // 8, place % 8]
            for k in range(4):
                place = node_faces[n, k]
                if place >= 0:
                    if touched[env, place // 4] > 0:
                        applied += face_force[env, place // 4, place % 4]
            if wp.static(gravity):
                applied += weight[env] * node_mass[n]
            if wp.static(inertia):
                inner += (u[env, n] - predicted[env, n]) * (inertia_rate[env] * node_mass[n])
            r = (applied - inner) * real(free[n])
            applied = applied * real(free[n])
            residual_out[env, n] = r
            square += wp.float64(wp.dot(r, r))
            applied_square += wp.float64(wp.dot(applied, applied))
            slope -= wp.float64(wp.dot(r, direction[env, n]))
        sums_out[env, run, 0] = square
        sums_out[env, run, 1] = applied_square
        sums_out[env, run, 2] = slope

    return residual


@functools.cache
def tangent_kernel(real):
    """Kernel of the tangent times a vector, from what elements and faces gave."""
    vec3 = vector_of(real)

    @wp.kernel(enable_backward=False, module="unique")
    def tangent(
        # Mesh:
        node_elements: wp.array2d(dtype=wp.int32),
        node_faces: wp.array2d(dtype=wp.int32),
        free: wp.array(dtype=wp.int32),
        node_mass: wp.array(dtype=real),
        # Stiffness of a unit volume against any motion (inertia, damping), by environment
        shift: wp.array(dtype=real),
        # In:
        active: wp.array(dtype=wp.int32),
        element_force: wp.array3d(dtype=vec3),
        touched: wp.array2d(dtype=wp.int32),
        face_force: wp.array3d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        # Out: the tangent times v, and partial sums of v . (tangent v)
        product_out: wp.array2d(dtype=vec3),
        sums_out: wp.array3d(dtype=wp.float64),
    ):
        env, run = wp.tid()
        if active[env] == 0:
            return
        curvature = wp.float64(0.0)
        last = wp.min((run + 1) * RUN, free.shape[0])
        for n in range(run * RUN, last):
            total = vec3()
            for k in range(8):
                place = node_elements[n, k]
                if place >= 0:
                    total += element_force[env, place // 8, place % 8]
            for k in range(4):
                place = node_faces[n, k]
                if place >= 0:
                    if touched[env, place // 4] > 0:
                        total += face_force[env, place // 4, place % 4]
            total += v[env, n] * (shift[env] * node_mass[n])
            total = total * real(free[n])
            product_out[env, n] = total
            curvature += wp.float64(wp.dot(total, v[env, n]))
        sums_out[env, run, 0] = curvature

    return tangent


@functools.cache
def reduce_kernel():
    """Kernel that adds the partial sums (B, runs, 3) of each environment up to (B, 3)."""

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
        for run in range(sums.shape[1]):
            total += sums[env, run, which]
        totals_out[env, which] = total

    return reduce


@functools.cache
def jacobi_kernel(real):
    """Kernel that inverts each node's 3x3 block of the tangent: the preconditioner.

    The elastic part is that of the undeformed body, whose two terms are the same for every
    environment; contact and mass are those of the state.
    """
    mat33 = matrix_of(real)

    @wp.kernel(enable_backward=False, module="unique")
    def jacobi(
        # Mesh:
        node_faces: wp.array2d(dtype=wp.int32),
        free: wp.array(dtype=wp.int32),
        node_mass: wp.array(dtype=real),
        shear_block: wp.array(dtype=mat33),
        bulk_block: wp.array(dtype=mat33),
        # Material, by environment:
        shear: wp.array(dtype=real),
        bulk: wp.array(dtype=real),
        factor: wp.array(dtype=real),
        bulk_factor: wp.array(dtype=real),
        shift: wp.array(dtype=real),
        # In:
        active: wp.array(dtype=wp.int32),
        touched: wp.array2d(dtype=wp.int32),
        face_block: wp.array3d(dtype=mat33),
        # Out:
        inverse_out: wp.array2d(dtype=mat33),
    ):
        env, n = wp.tid()
        if active[env] == 0:
            return
        if free[n] == 0:
            inverse_out[env, n] = mat33()
            return
        block = shear_block[n] * (shear[env] * factor[env])
        block += bulk_block[n] * (bulk[env] * bulk_factor[env])
        for k in range(4):
            place = node_faces[n, k]
            if place >= 0:
                if touched[env, place // 4] > 0:
                    block += face_block[env, place // 4, place % 4]
        block += wp.identity(n=3, dtype=real) * (shift[env] * node_mass[n])
        inverse_out[env, n] = wp.inverse(block)

    return jacobi
