# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""A particle's time step: take velocity and its gradient from the grid, move, give momentum back.

MLS-MPM (Hu et al., A moving least squares material point method, 2018, eq. 16) with affine
transfers. Both transfers are one kernel: velocity and its gradient live in registers between them,
and a particle keeps only its displacement and its displacement gradient. Lengths are in cells,
times in time steps, masses in that of a cell of the material.
"""

import functools

import warp as wp

from sim.fem.scalars import matrix_of, vector_of
from sim.mpm.law import law_functions
from sim.mpm.spline import FIXED_POINT, MOMENT, spline_functions

LEFT_GRID, COLLAPSED, TOO_FAST = 1, 2, 3
"""Why a simulation ended early."""
SPEED_LIMIT = 0.5
"""Cells a particle may move in a step: far beyond anything stable."""


@functools.cache
def particle_kernel(real):
    """Kernel of a particle's time step, for one precision."""
    vec3, mat33 = vector_of(real), matrix_of(real)
    first_node, weights, arms = spline_functions(real)
    dilatation, kirchhoff, _energy = law_functions(real)
    one, moment, unit = real(1.0), real(MOMENT), real(FIXED_POINT)

    @wp.kernel(enable_backward=False, module="unique")
    def move(
        # Settings:
        nodes: wp.vec3i,
        corner: wp.vec3i,
        held: int,
        det_floor: real,
        # Particles, shared by all environments:
        rest: wp.array(dtype=vec3),
        volume: wp.array(dtype=real),
        # Environments:
        active: wp.array(dtype=wp.int32),
        shear: wp.array(dtype=real),
        bulk: wp.array(dtype=real),
        # In:
        velocity: wp.array2d(dtype=vec3),
        # In and out: displacement, and its gradient
        shift: wp.array2d(dtype=vec3),
        gradient: wp.array2d(dtype=mat33),
        # Out: mass and momentum at nodes, and why an environment ended
        sums_out: wp.array3d(dtype=wp.int64),
        status_out: wp.array(dtype=wp.int32),
    ):
        env, p = wp.tid()
        if active[env] == 0:
            return
        u = shift[env, p]
        x = rest[p] + u
        first, offset = first_node(x)
        first += corner
        w = weights(offset)
        arm = arms(offset)
        v = vec3()
        affine = mat33()
        for i in range(3):
            for j in range(3):
                row = ((first[0] + i) * nodes[1] + first[1] + j) * nodes[2] + first[2]
                for k in range(3):
                    share = velocity[env, row + k] * (w[0, i] * w[1, j] * w[2, k])
                    v += share
                    affine += wp.outer(share, vec3(arm[0, i], arm[1, j], arm[2, k]))
        affine = affine * moment
        if p < held:
            v = vec3()
        u += v
        h = gradient[env, p]
        h += affine + affine * h
        shift[env, p] = u
        gradient[env, p] = h

        # Written so that a NaN fails every check.
        if not (wp.length_sq(v) < real(SPEED_LIMIT * SPEED_LIMIT)):
            wp.atomic_max(status_out, env, TOO_FAST)
            return
        if not (one + dilatation(h) > det_floor):
            wp.atomic_max(status_out, env, COLLAPSED)
            return
        x = rest[p] + u
        first, offset = first_node(x)
        first += corner
        for axis in range(3):
            if first[axis] < 0 or first[axis] + 2 >= nodes[axis]:
                wp.atomic_max(status_out, env, LEFT_GRID)
                return

        w = weights(offset)
        arm = arms(offset)
        mass = volume[p]
        push = affine * mass - kirchhoff(h, shear[env], bulk[env]) * (moment * mass)
        momentum = v * mass
        for i in range(3):
            for j in range(3):
                row = ((first[0] + i) * nodes[1] + first[1] + j) * nodes[2] + first[2]
                for k in range(3):
                    weight = w[0, i] * w[1, j] * w[2, k] * unit
                    given = (momentum + push * vec3(arm[0, i], arm[1, j], arm[2, k])) * weight
                    wp.atomic_add(sums_out, env, row + k, 0, wp.int64(mass * weight))
                    wp.atomic_add(sums_out, env, row + k, 1, wp.int64(given[0]))
                    wp.atomic_add(sums_out, env, row + k, 2, wp.int64(given[1]))
                    wp.atomic_add(sums_out, env, row + k, 3, wp.int64(given[2]))

    return move
