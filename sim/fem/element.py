# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Elastic (and viscous) forces of 8-node hexahedra with mean dilatation.

Isochoric neo-Hookean with one volume change theta per element (Simo, Taylor & Pister 1985):
W = G/2 (J^(-2/3) tr(F^T F) - 3) + K/2 ((theta^2 - 1)/2 - ln theta), theta = deformed/rest volume.
Full displacement elements lock near nu = 0.5; these do not.

The displacement of an element is written in the 7 modes xi, eta, zeta, xi eta, eta zeta, xi zeta,
xi eta zeta (its Walsh-Hadamard transform), whose gradients at the Gauss points are sums with signs:
less than half the arithmetic of 8 nodes times 8 points. Everything is in units of the body's
thickness and modulus, one thread an element of one environment.
"""

import functools

import warp as wp

from sim.fem.scalars import matrix_of, vector_of

GAUSS_POINTS = 8


@functools.cache
def column_function(real):
    """`column(m, j)`: a column of a matrix, as a vector."""
    vec3 = vector_of(real)
    mat33 = matrix_of(real)

    @wp.func
    def column(m: mat33, j: int):
        return vec3(m[0, j], m[1, j], m[2, j])

    return column


@functools.cache
def nodal_function(real, kind):
    """`nodal(m1, ..., m7)` -> 8 values by corner, of vectors or matrices: `modes_of` transposed."""
    eighth = real(0.125)
    g = real(0.5773502691896258)
    gg = real(1.0 / 3.0)

    @wp.func
    def nodal(m1: kind, m2: kind, m3: kind, m4: kind, m5: kind, m6: kind, m7: kind):
        a1 = m1 * eighth
        a2 = m2 * eighth
        a3 = m3 * eighth
        a4 = m4 * (eighth * g)
        a5 = m5 * (eighth * g)
        a6 = m6 * (eighth * g)
        a7 = m7 * (eighth * gg)
        # Corner (i, j, k) takes every mode with the product of its signs.
        l0 = -a1 - a2 + a4
        h0 = -a3 + a5 + a6 - a7
        l1 = -a1 + a2 - a4
        h1 = -a3 - a5 + a6 + a7
        l2 = a1 - a2 - a4
        h2 = -a3 + a5 - a6 + a7
        l3 = a1 + a2 + a4
        h3 = -a3 - a5 - a6 - a7
        return l0 + h0, l0 - h0, l1 + h1, l1 - h1, l2 + h2, l2 - h2, l3 + h3, l3 - h3

    return nodal


@functools.cache
def mode_functions(real):
    """`modes_of(elements, u, env, e)` -> 7 vectors; `scatter(...)` writes its transpose."""
    vec3 = vector_of(real)
    eighth = real(0.125)
    g = real(0.5773502691896258)
    gg = real(1.0 / 3.0)

    @wp.func
    def modes_of(elements: wp.array2d(dtype=wp.int32), u: wp.array2d(dtype=vec3), env: int, e: int):
        v0 = u[env, elements[e, 0]]
        v1 = u[env, elements[e, 1]]
        v2 = u[env, elements[e, 2]]
        v3 = u[env, elements[e, 3]]
        v4 = u[env, elements[e, 4]]
        v5 = u[env, elements[e, 5]]
        v6 = u[env, elements[e, 6]]
        v7 = u[env, elements[e, 7]]
        s01 = v0 + v1
        s23 = v2 + v3
        s45 = v4 + v5
        s67 = v6 + v7
        d01 = v1 - v0
        d23 = v3 - v2
        d45 = v5 - v4
        d67 = v7 - v6
        m1 = ((s45 + s67) - (s01 + s23)) * eighth
        m2 = ((s23 - s01) + (s67 - s45)) * eighth
        m3 = ((d01 + d23) + (d45 + d67)) * eighth
        m4 = ((s67 - s45) - (s23 - s01)) * (eighth * g)
        m5 = ((d23 - d01) + (d67 - d45)) * (eighth * g)
        m6 = ((d45 + d67) - (d01 + d23)) * (eighth * g)
        m7 = ((d67 - d45) - (d23 - d01)) * (eighth * gg)
        return m1, m2, m3, m4, m5, m6, m7

    nodal = nodal_function(real, vec3)

    @wp.func
    def scatter(
        force: wp.array3d(dtype=vec3),
        env: int,
        e: int,
        m1: vec3,
        m2: vec3,
        m3: vec3,
        m4: vec3,
        m5: vec3,
        m6: vec3,
        m7: vec3,
    ):
        v0, v1, v2, v3, v4, v5, v6, v7 = nodal(m1, m2, m3, m4, m5, m6, m7)
        force[env, e, 0] = v0
        force[env, e, 1] = v1
        force[env, e, 2] = v2
        force[env, e, 3] = v3
        force[env, e, 4] = v4
        force[env, e, 5] = v5
        force[env, e, 6] = v6
        force[env, e, 7] = v7

    return modes_of, scatter


@functools.cache
def strain_functions(real):
    """`strain`, `cofactor`, `det_less_one`: what every kernel needs of F."""
    vec3 = vector_of(real)
    mat33 = matrix_of(real)

    @wp.func
    def strain(
        m1: vec3, m2: vec3, m3: vec3, m4: vec3, m5: vec3, m6: vec3, m7: vec3, q: int, inv: mat33
    ):
        """Gradient of the displacement at Gauss point q, as a matrix."""
        sx = real(2 * (q >> 2) - 1)
        sy = real(2 * ((q >> 1) & 1) - 1)
        sz = real(2 * (q & 1) - 1)
        gx = m1 + m4 * sy + m6 * sz + m7 * (sy * sz)
        gy = m2 + m4 * sx + m5 * sz + m7 * (sx * sz)
        gz = m3 + m5 * sy + m6 * sx + m7 * (sx * sy)
        return wp.matrix_from_cols(gx, gy, gz) * inv, sx, sy, sz

    @wp.func
    def cofactor(f: mat33):
        c0 = wp.vector(f[0, 0], f[1, 0], f[2, 0])
        c1 = wp.vector(f[0, 1], f[1, 1], f[2, 1])
        c2 = wp.vector(f[0, 2], f[1, 2], f[2, 2])
        return wp.matrix_from_cols(wp.cross(c1, c2), wp.cross(c2, c0), wp.cross(c0, c1))

    @wp.func
    def det_less_one(h: mat33):
        """det(1 + h) - 1 without the cancellation that would cost float32 half its digits."""
        minors = (
            h[0, 0] * h[1, 1]
            - h[0, 1] * h[1, 0]
            + h[1, 1] * h[2, 2]
            - h[1, 2] * h[2, 1]
            + h[0, 0] * h[2, 2]
            - h[0, 2] * h[2, 0]
        )
        return wp.trace(h) + minors + wp.determinant(h)

    return strain, cofactor, det_less_one


@functools.cache
def element_kernels(real, viscous: bool, full_integration: bool = False):
    """Kernel of the forces for one precision and combination of effects.

    `viscous` compiles the Prony history in; without it no trace of it is left. `full_integration`
    is the planted mistake.
    """
    vec3 = vector_of(real)
    mat33 = matrix_of(real)
    modes_of, scatter = mode_functions(real)
    strain, cofactor, det_less_one = strain_functions(real)
    half, one, two, three = real(0.5), real(1.0), real(2.0), real(3.0)
    third = real(1.0 / 3.0)
    # Divided here: inside a kernel the quotient would be float32 whatever `real` is.
    power = real(-2.0 / 3.0)

    @wp.kernel(enable_backward=False, module="unique")
    def residual(
        # Mesh:
        elements: wp.array2d(dtype=wp.int32),
        inverse: wp.array3d(dtype=mat33),
        weight: wp.array3d(dtype=real),
        variant: wp.array(dtype=wp.int32),
        points: int,
        # Material, by environment:
        shear: wp.array(dtype=real),
        bulk: wp.array(dtype=real),
        factor: wp.array(dtype=real),
        bulk_factor: wp.array(dtype=real),
        history: wp.array3d(dtype=mat33),
        bulk_history: wp.array2d(dtype=real),
        # In:
        active: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
        # Out:
        force_out: wp.array3d(dtype=vec3),
        energy_out: wp.array2d(dtype=real),
        det_out: wp.array2d(dtype=real),
    ):
        env, e = wp.tid()
        last = inverse.shape[2] - 1  # boxes have one Jacobian for all Gauss points
        if active[env] == 0:
            return
        m = variant[env]
        u1, u2, u3, u4, u5, u6, u7 = modes_of(elements, u, env, e)
        volume = real(0.0)
        change = real(0.0)
        lowest = real(1.0e30)
        for q in range(points):
            h, _sx, _sy, _sz = strain(u1, u2, u3, u4, u5, u6, u7, q, inverse[m, e, wp.min(q, last)])
            j = det_less_one(h)
            volume += weight[m, e, q]
            change += weight[m, e, q] * j
            lowest = wp.min(lowest, one + j)
        det_out[env, e] = lowest
        theta = change / volume
        pressure = half * bulk[env] * theta * (two + theta) / (one + theta)
        energy = (
            volume
            * half
            * bulk[env]
            * (half * theta * (two + theta) - wp.log(wp.max(one + theta, real(1.0e-30))))
        )
        if wp.static(viscous):
            pressure = bulk_factor[env] * pressure + bulk_history[env, e]
        f1 = vec3()
        f2 = vec3()
        f3 = vec3()
        f4 = vec3()
        f5 = vec3()
        f6 = vec3()
        f7 = vec3()
        for q in range(points):
            h, sx, sy, sz = strain(u1, u2, u3, u4, u5, u6, u7, q, inverse[m, e, wp.min(q, last)])
            f = h + wp.identity(n=3, dtype=real)
            c = cofactor(f)
            less = det_less_one(h)
            j = one + less
            w = weight[m, e, q]
            square = wp.ddot(f, f)
            g = shear[env] * wp.pow(wp.max(j, real(1.0e-30)), power)
            if wp.static(full_integration):
                pressure = half * bulk[env] * less * (two + less) / j
            energy += w * half * (g * square - three * shear[env])
            # F - cof(F) tr(F^T F) / 3J, written in h = F - 1: nothing cancels at small strain
            trace = wp.trace(h)
            excess = (two * trace + wp.ddot(h, h) - three * less) * (third / j)
            stress = h + wp.transpose(h) - cofactor(h) - c * excess
            stress = (stress - wp.identity(n=3, dtype=real) * trace) * g
            if wp.static(viscous):
                stress = stress * factor[env] + f * history[env, e, q]
            stress = (stress + c * pressure) * w
            t = stress * wp.transpose(inverse[m, e, wp.min(q, last)])
            tx = wp.vector(t[0, 0], t[1, 0], t[2, 0])
            ty = wp.vector(t[0, 1], t[1, 1], t[2, 1])
            tz = wp.vector(t[0, 2], t[1, 2], t[2, 2])
            f1 += tx
            f2 += ty
            f3 += tz
            f4 += tx * sy + ty * sx
            f5 += ty * sz + tz * sy
            f6 += tx * sz + tz * sx
            f7 += tx * (sy * sz) + ty * (sx * sz) + tz * (sx * sy)
        energy_out[env, e] = energy
        scatter(force_out, env, e, f1, f2, f3, f4, f5, f6, f7)

    return residual
