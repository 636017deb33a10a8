# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""What the particles say at a waypoint: surface, energy, and how far the material is squeezed."""

import functools

import warp as wp

from sim.fem.scalars import matrix_of, vector_of
from sim.mpm.law import law_functions
from sim.mpm.spline import FIXED_POINT, spline_functions


@functools.cache
def reading_kernels(real):
    """Kernels of the surface's displacement and of the whole body's sums, for one precision."""
    vec3, mat33 = vector_of(real), matrix_of(real)
    first_node, weights, _arms = spline_functions(real)
    dilatation, _kirchhoff, energy = law_functions(real)
    one, half, unit = real(1.0), real(0.5), real(FIXED_POINT)

    @wp.kernel(enable_backward=False, module="unique")
    def surface(
        # Particles: the first of the highest layer, and the way from each of it to the surface
        first: int,
        to_surface: wp.array(dtype=vec3),
        # In:
        shift: wp.array2d(dtype=vec3),
        gradient: wp.array2d(dtype=mat33),
        # Out: displacement of the surface
        surface_out: wp.array2d(dtype=vec3),
    ):
        env, n = wp.tid()
        bent = gradient[env, first + n] * to_surface[n]
        surface_out[env, n] = shift[env, first + n] + bent

    @wp.kernel(enable_backward=False, module="unique")
    def body(
        # Settings:
        nodes: wp.vec3i,
        corner: wp.vec3i,
        # Particles:
        rest: wp.array(dtype=vec3),
        volume: wp.array(dtype=real),
        whole: real,
        # Environments:
        status: wp.array(dtype=wp.int32),
        shear: wp.array(dtype=real),
        bulk: wp.array(dtype=real),
        # In:
        velocity: wp.array2d(dtype=vec3),
        shift: wp.array2d(dtype=vec3),
        gradient: wp.array2d(dtype=mat33),
        # Out: means over the body of stored and kinetic energy and displacement (5 numbers),
        # and the smallest determinant
        sums_out: wp.array2d(dtype=wp.int64),
        det_out: wp.array(dtype=real),
    ):
        env, p = wp.tid()
        if status[env] != 0:
            return
        h = gradient[env, p]
        u = shift[env, p]
        x = rest[p] + u
        first, offset = first_node(x)
        first += corner
        w = weights(offset)
        v = vec3()
        for i in range(3):
            for j in range(3):
                row = ((first[0] + i) * nodes[1] + first[1] + j) * nodes[2] + first[2]
                for k in range(3):
                    v += velocity[env, row + k] * (w[0, i] * w[1, j] * w[2, k])
        share = volume[p] / whole * unit
        stored = energy(h, shear[env], bulk[env]) * share
        wp.atomic_add(sums_out, env, 0, wp.int64(stored))
        wp.atomic_add(sums_out, env, 1, wp.int64(half * wp.length_sq(v) * share))
        for c in range(3):
            wp.atomic_add(sums_out, env, 2 + c, wp.int64(u[c] * share))
        wp.atomic_min(det_out, env, one + dilatation(h))

    return surface, body
