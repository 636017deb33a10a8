# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Elastic and viscous forces of 8-node hexahedra with mean dilatation, and their tangents.

Isochoric neo-Hookean with one volume change theta per element (Simo, Taylor & Pister 1985):
W = G/2 (J^(-2/3) tr(F^T F) - 3) + K/2 ((theta^2 - 1)/2 - ln theta), theta = deformed/rest volume.
Full displacement elements lock near nu = 0.5; these do not.

The displacement of an element is written in the 7 modes xi, eta, zeta, xi eta, eta zeta, xi zeta,
xi eta zeta (its Walsh-Hadamard transform), whose gradients at the Gauss points are signed sums:
less than half the arithmetic of 8 nodes times 8 points. All quantities are in units of the body's
thickness and modulus, with one thread per element of each environment. GPUs use these kernels, and
CPUs those of `sim.fem.lanes`.
"""

import functools

import numpy as np
import warp as wp

from sim.scalars import det_less_one_function, matrix_of, numpy_of, vector_of

GAUSS_POINTS = 8


@functools.cache
def column_function(real):
    """Return the function `column(m, j)`: a column of a matrix, as a vector."""
    vec3 = vector_of(real)
    mat33 = matrix_of(real)

    @wp.func
    def column(m: mat33, j: int):
        return vec3(m[0, j], m[1, j], m[2, j])

    return column


@functools.cache
def nodal_function(real, kind):
    """Return `nodal(m1, ..., m7)` -> 8 corner vectors or matrices: `modes_of` transposed."""
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
        # Each corner (i, j, k) sums all modes, each with the product of its signs.
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
    """Return `modes_of(elements, u, env, e)` -> 7 vectors, and `scatter(...)`, its transpose."""
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
def kinematics(real):
    """Return the shared `strain`, `cofactor`, `deformed`, `mean_change` and `pressure_of`."""
    vec3 = vector_of(real)
    mat33 = matrix_of(real)
    half, one, two = real(0.5), real(1.0), real(2.0)

    @wp.func
    def strain(
        m1: vec3, m2: vec3, m3: vec3, m4: vec3, m5: vec3, m6: vec3, m7: vec3, q: int, inv: mat33
    ):
        """Return the displacement gradient at Gauss point q, and the signs of its coordinates."""
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

    det_less_one = det_less_one_function(real)

    @wp.func
    def deformed(h: mat33):
        """Return F = 1 + h, its cofactor, J - 1, J and |F|^2."""
        f = h + wp.identity(n=3, dtype=real)
        less = det_less_one(h)
        return f, cofactor(f), less, one + less, wp.ddot(f, f)

    @wp.func
    def mean_change(
        inverse: wp.array3d(dtype=mat33),
        weight: wp.array3d(dtype=real),
        m: int,
        e: int,
        points: int,
        u1: vec3,
        u2: vec3,
        u3: vec3,
        u4: vec3,
        u5: vec3,
        u6: vec3,
        u7: vec3,
    ):
        """Return an element's rest volume, mean volume change, and least J at its Gauss points."""
        last = inverse.shape[2] - 1  # boxes have one Jacobian for all Gauss points
        volume = real(0.0)
        change = real(0.0)
        lowest = real(1.0e30)
        for q in range(points):
            h, _sx, _sy, _sz = strain(u1, u2, u3, u4, u5, u6, u7, q, inverse[m, e, wp.min(q, last)])
            less = det_less_one(h)
            volume += weight[m, e, q]
            change += weight[m, e, q] * less
            lowest = wp.min(lowest, one + less)
        return volume, change / volume, lowest

    @wp.func
    def pressure_of(bulk: real, theta: real):
        """Return the derivative of the energy by the volume, at the mean change of volume."""
        return half * bulk * theta * (two + theta) / (one + theta)

    return strain, cofactor, deformed, mean_change, pressure_of


@functools.cache
def element_kernels(real, viscous: bool, split: bool = False):
    """Return the kernel of the forces for one precision and combination of effects.

    `viscous` compiles the Prony history in, `split` that of the pressure alone (`sim.fem.volume`);
    without them none of that code is compiled.
    """
    vec3 = vector_of(real)
    mat33 = matrix_of(real)
    modes_of, scatter = mode_functions(real)
    strain, cofactor, deformed, mean_change, pressure_of = kinematics(real)
    half, one, two, three = real(0.5), real(1.0), real(2.0), real(3.0)
    third = real(1.0 / 3.0)
    # Divided here: inside a kernel the quotient would be float32 for any `real`.
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
        if weight[m, e, 0] == real(0.0):  # outside a round body
            return
        u1, u2, u3, u4, u5, u6, u7 = modes_of(elements, u, env, e)
        volume, theta, lowest = mean_change(
            inverse, weight, m, e, points, u1, u2, u3, u4, u5, u6, u7
        )
        det_out[env, e] = lowest
        pressure = pressure_of(bulk[env], theta)
        energy = (
            volume
            * half
            * bulk[env]
            * (half * theta * (two + theta) - wp.log(wp.max(one + theta, real(1.0e-30))))
        )
        if wp.static(viscous or split):
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
            f, c, less, j, square = deformed(h)
            w = weight[m, e, q]
            g = shear[env] * wp.pow(wp.max(j, real(1.0e-30)), power)
            energy += w * half * (g * square - three * shear[env])
            # F - cof(F) tr(F^T F) / 3J in terms of h = F - 1: no cancellation at small strain
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


# Tangent of an element: the derivative of the forces of `element_kernels`, written out.
#
# With G_r = row r of the inverse Jacobian, f_r = F G_r, c_r = cof(F) G_r and g = G J^(-2/3), the
# 3x3 block between reference directions r and s at one Gauss point is
#
# g (G_r.G_s) 1 - 2g/3J (f_r c_s^T + c_r f_s^T) + 5g |F|^2/9J^2 c_r c_s^T + (p - g |F|^2/3J) dcof
#
# where dcof v = v x F(G_r x G_s); mean dilatation adds one outer product per element.


@functools.cache
def tangent_functions(real, viscous: bool, split: bool = False):
    """Return `of_mean` and `at_point`, of an element and of its Gauss points.

    `viscous` and `split` as in `element_kernels`.
    """
    vec3 = vector_of(real)
    mat33 = matrix_of(real)
    _strain, cofactor, deformed, mean_change, pressure_of = kinematics(real)
    half, one, two = real(0.5), real(1.0), real(2.0)
    # Divided here: inside a kernel the quotient would be float32 for any `real`.
    third, power, five_thirds = real(1.0 / 3.0), real(-2.0 / 3.0), real(5.0 / 3.0)

    @wp.func
    def of_mean(
        inverse: wp.array3d(dtype=mat33),
        weight: wp.array3d(dtype=real),
        kind: int,
        bulk: wp.array(dtype=real),
        bulk_factor: wp.array(dtype=real),
        bulk_history: wp.array2d(dtype=real),
        env: int,
        e: int,
        corners: int,
        u1: vec3,
        u2: vec3,
        u3: vec3,
        u4: vec3,
        u5: vec3,
        u6: vec3,
        u7: vec3,
    ):
        """Return an element's pressure, and its derivative by mean volume change, per volume."""
        volume, theta, _lowest = mean_change(
            inverse, weight, kind, e, corners, u1, u2, u3, u4, u5, u6, u7
        )
        pressure = pressure_of(bulk[env], theta)
        stiffness = half * bulk[env] * (one + one / ((one + theta) * (one + theta)))
        if wp.static(viscous or split):
            pressure = bulk_factor[env] * pressure + bulk_history[env, e]
            stiffness = bulk_factor[env] * stiffness
        return pressure, stiffness / volume

    @wp.func
    def at_point(
        h: mat33,
        inv: mat33,
        w: real,
        pressure: real,
        shear: wp.array(dtype=real),
        factor: wp.array(dtype=real),
        history: wp.array3d(dtype=mat33),
        convex: int,
        env: int,
        e: int,
        q: int,
    ):
        """Return the vectors c_r and e_r, the metric, and the columns of `turn` at Gauss point q.

        With them the block between reference directions r and s is e_r c_s^T + c_r e_s^T +
        metric_rs, less the cross product with the column that belongs to both.
        """
        f, c, _less, j, square = deformed(h)
        g = shear[env] * wp.pow(j, power)
        if wp.static(viscous):
            g = g * factor[env]
        over = g * third / j
        mixed = w * over * five_thirds * square / j
        across = wp.transpose(inv)
        cr = c * across
        # Half of the c c^T term on either side makes it a product with its transpose.
        er = cr * (mixed * half) - (f * across) * (w * two * over)
        metric = (inv * across) * (w * g)
        if wp.static(viscous):
            metric += (inv * history[env, e, q] * across) * w
        # F (G_1 x G_2), F (G_2 x G_0), F (G_0 x G_1), times their factor
        turning = pressure - over * square
        if convex == 1:
            # The square of the largest stretch is at most that of matrices with this trace and
            # norm (Wolkowicz & Styan 1980).
            stretch = wp.transpose(f) * f
            mean = square * third
            spread = wp.max(wp.ddot(stretch, stretch) * third - mean * mean, real(0.0))
            most = g / wp.sqrt(mean + wp.sqrt(two * spread))
            turning = wp.clamp(turning, -most, most)
        turn = f * wp.transpose(cofactor(inv)) * (w * turning)
        return cr, er, metric, turn

    return of_mean, at_point


# The same with one row of 3x3 blocks per thread, as a GPU assembles it; a CPU by `sim.fem.lanes`.
#
# The 8 blocks of a row stay in registers; all 64 of an element do not, and a GPU's threads would
# wait for memory.
#
# With A the reference derivatives of the shape function of the row's node, B those of a mode of the
# other, and the rest as above, one Gauss point adds
#
#     (A . metric B) 1 + e_A c_B^T + c_A e_B^T - skew(turn (A x B))
#
# It is linear in B, so it is computed for three directions. Modes sum those over the Gauss points
# as they do forces, and `nodal_function` turns modes into blocks as it does into forces. It takes
# about 65,000 operations an element; node by node it would be 90,000.


@functools.cache
def element_rows_kernel(real, viscous: bool, split: bool = False):
    """Return the kernel that adds tangents by rows; no two elements of a launch share a node."""
    vec3 = vector_of(real)
    mat33 = matrix_of(real)
    modes_of, _scatter = mode_functions(real)
    column = column_function(real)
    blocks_of = nodal_function(real, mat33)
    strain = kinematics(real)[0]
    of_mean, at_point = tangent_functions(real, viscous, split)
    half = real(0.5)
    near, far = real(0.5 + 0.5 / 3.0**0.5), real(0.5 - 0.5 / 3.0**0.5)

    @wp.func
    def slope(q: int, b: int):
        """Return the reference derivatives of corner b's shape function at Gauss point q."""
        apart = q ^ b
        x = wp.where((apart >> 2) & 1 == 0, near, far)
        y = wp.where((apart >> 1) & 1 == 0, near, far)
        z = wp.where(apart & 1 == 0, near, far)
        along_x = wp.where((b >> 2) & 1 == 1, half, -half)
        along_y = wp.where((b >> 1) & 1 == 1, half, -half)
        along_z = wp.where(b & 1 == 1, half, -half)
        return vec3(along_x * y * z, along_y * x * z, along_z * x * y)

    @wp.func
    def along(same: real, ea: vec3, c: vec3, ca: vec3, e: vec3, turned: vec3):
        """Return one Gauss point's block of the row's node and a derivative along a direction."""
        straight = wp.identity(n=3, dtype=real) * same
        return straight + wp.outer(ea, c) + wp.outer(ca, e) - wp.skew(turned)

    @wp.func
    def spread(bits: int):
        """Return the offset in a stencil's 27 slots for steps along x, y, z packed in 3 bits."""
        return 9 * (bits >> 2) + 3 * ((bits >> 1) & 1) + (bits & 1)

    @wp.func
    def add(
        elements: wp.array2d(dtype=wp.int32),
        free: wp.array(dtype=wp.int32),
        env: int,
        e: int,
        a: int,
        b: int,
        found: mat33,
        matrix_out: wp.array3d(dtype=mat33),
    ):
        if free[elements[e, b]] == 1:
            n = elements[e, a]
            slot = 13 - spread(a) + spread(b)
            matrix_out[env, n, slot] = matrix_out[env, n, slot] + found

    @wp.kernel(enable_backward=False, module="unique")
    def element_rows(
        # Mesh, by variant; order of the elements, first one of the launch, nodes that move
        elements: wp.array2d(dtype=wp.int32),
        inverse: wp.array3d(dtype=mat33),
        weight: wp.array3d(dtype=real),
        variant: wp.array(dtype=wp.int32),
        order: wp.array(dtype=wp.int32),
        first: int,
        free: wp.array(dtype=wp.int32),
        corners: int,
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
        convex: wp.array(dtype=wp.int32),
        # In and out:
        matrix_out: wp.array3d(dtype=mat33),
    ):
        env, a, position = wp.tid()
        last = inverse.shape[2] - 1  # boxes have one Jacobian for all Gauss points
        if active[env] == 0:
            return
        e = order[first + position]
        if free[elements[e, a]] == 0:
            return
        kind = variant[env]
        if weight[kind, e, 0] == real(0.0):  # outside a round body
            return
        u1, u2, u3, u4, u5, u6, u7 = modes_of(elements, u, env, e)
        pressure, stiffness = of_mean(
            inverse,
            weight,
            kind,
            bulk,
            bulk_factor,
            bulk_history,
            env,
            e,
            corners,
            u1,
            u2,
            u3,
            u4,
            u5,
            u6,
            u7,
        )

        # Blocks of the row and gradients of the volume, by modes of the other node, summed over
        # Gauss points as the forces are. Separate names, because registers cannot be indexed.
        k1 = mat33()
        k2 = mat33()
        k3 = mat33()
        k4 = mat33()
        k5 = mat33()
        k6 = mat33()
        k7 = mat33()
        m1 = vec3()
        m2 = vec3()
        m3 = vec3()
        m4 = vec3()
        m5 = vec3()
        m6 = vec3()
        m7 = vec3()
        mean = vec3()
        for q in range(corners):
            inv = inverse[kind, e, wp.min(q, last)]
            w = weight[kind, e, q]
            h, sx, sy, sz = strain(u1, u2, u3, u4, u5, u6, u7, q, inv)
            cr, er, metric, turn = at_point(
                h, inv, w, pressure, shear, factor, history, convex[env], env, e, q
            )
            sa = slope(q, a)
            ma = wp.transpose(metric) * sa
            ca = cr * sa
            ea = er * sa
            cx = column(cr, 0)
            cy = column(cr, 1)
            cz = column(cr, 2)
            px = column(turn, 0)
            py = column(turn, 1)
            pz = column(turn, 2)
            bx = along(ma[0], ea, cx, ca, column(er, 0), py * sa[2] - pz * sa[1])
            by = along(ma[1], ea, cy, ca, column(er, 1), pz * sa[0] - px * sa[2])
            bz = along(ma[2], ea, cz, ca, column(er, 2), px * sa[1] - py * sa[0])
            k1 += bx
            k2 += by
            k3 += bz
            k4 += bx * sy + by * sx
            k5 += by * sz + bz * sy
            k6 += bx * sz + bz * sx
            k7 += bx * (sy * sz) + by * (sx * sz) + bz * (sx * sy)
            mean += ca * w
            cx = cx * w
            cy = cy * w
            cz = cz * w
            m1 += cx
            m2 += cy
            m3 += cz
            m4 += cx * sy + cy * sx
            m5 += cy * sz + cz * sy
            m6 += cx * sz + cz * sx
            m7 += cx * (sy * sz) + cy * (sx * sz) + cz * (sx * sy)

        # The product with the mean of all volume changes is linear in the modes as well.
        mean = mean * stiffness
        k1 += wp.outer(mean, m1)
        k2 += wp.outer(mean, m2)
        k3 += wp.outer(mean, m3)
        k4 += wp.outer(mean, m4)
        k5 += wp.outer(mean, m5)
        k6 += wp.outer(mean, m6)
        k7 += wp.outer(mean, m7)
        b0, b1, b2, b3, b4, b5, b6, b7 = blocks_of(k1, k2, k3, k4, k5, k6, k7)
        add(elements, free, env, e, a, 0, b0, matrix_out)
        add(elements, free, env, e, a, 1, b1, matrix_out)
        add(elements, free, env, e, a, 2, b2, matrix_out)
        add(elements, free, env, e, a, 3, b3, matrix_out)
        add(elements, free, env, e, a, 4, b4, matrix_out)
        add(elements, free, env, e, a, 5, b5, matrix_out)
        add(elements, free, env, e, a, 6, b6, matrix_out)
        add(elements, free, env, e, a, 7, b7, matrix_out)

    return element_rows


# Prony branches at the Gauss points: their stored stresses, and the change over a step.
#
# Simo & Hughes, Computational Inelasticity (1998), section 10.3: the stress of branch i after a
# step dt is h = exp(-dt/time) h_old + ratio a (S - S_old) with a = (1 - exp(-dt/time)) time / dt, S
# the second Piola-Kirchhoff stress at rest. So within a step the stress is S (1 + sum ratio a) +
# history, where history = sum(exp(-dt/time) h_old) - sum(ratio a) S_old does not change. Element
# kernels need nothing else. The pressure of an element relaxes in the same way.


@functools.cache
def _kernels(real):
    vec3 = vector_of(real)
    mat33 = matrix_of(real)
    modes_of, _scatter = mode_functions(real)
    strain, _cofactor, deformed, mean_change, pressure_of = kinematics(real)
    third = real(1.0 / 3.0)
    power = real(-2.0 / 3.0)

    @wp.kernel(enable_backward=False, module="unique")
    def recall(
        # In: branch stresses (branch, env, element, point) and gains (env, branch)
        decay: wp.array2d(dtype=real),
        gain: wp.array2d(dtype=real),
        bulk_gain: wp.array2d(dtype=real),
        points: int,
        branch: wp.array4d(dtype=mat33),
        rest: wp.array3d(dtype=mat33),
        bulk_branch: wp.array3d(dtype=real),
        bulk_rest: wp.array2d(dtype=real),
        active: wp.array(dtype=wp.int32),
        # Out:
        history_out: wp.array3d(dtype=mat33),
        bulk_history_out: wp.array2d(dtype=real),
    ):
        env, e = wp.tid()
        if active[env] == 0:
            return
        for q in range(points):
            history = mat33()
            for i in range(decay.shape[1]):
                history += branch[i, env, e, q] * decay[env, i] - rest[env, e, q] * gain[env, i]
            history_out[env, e, q] = history
        bulk_history = real(0.0)
        for i in range(decay.shape[1]):
            bulk_history += (
                bulk_branch[i, env, e] * decay[env, i] - bulk_rest[env, e] * bulk_gain[env, i]
            )
        bulk_history_out[env, e] = bulk_history

    @wp.kernel(enable_backward=False, module="unique")
    def keep(
        # Mesh:
        elements: wp.array2d(dtype=wp.int32),
        inverse: wp.array3d(dtype=mat33),
        weight: wp.array3d(dtype=real),
        variant: wp.array(dtype=wp.int32),
        points: int,
        # Material, by environment:
        shear: wp.array(dtype=real),
        bulk: wp.array(dtype=real),
        decay: wp.array2d(dtype=real),
        gain: wp.array2d(dtype=real),
        bulk_gain: wp.array2d(dtype=real),
        # In:
        active: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
        # In and out:
        branch_out: wp.array4d(dtype=mat33),
        rest_out: wp.array3d(dtype=mat33),
        bulk_branch_out: wp.array3d(dtype=real),
        bulk_rest_out: wp.array2d(dtype=real),
    ):
        env, e = wp.tid()
        last = inverse.shape[2] - 1  # boxes have one Jacobian for all Gauss points
        if active[env] == 0:
            return
        m = variant[env]
        if weight[m, e, 0] == real(0.0):  # outside a round body
            return
        u1, u2, u3, u4, u5, u6, u7 = modes_of(elements, u, env, e)
        for q in range(points):
            h, _sx, _sy, _sz = strain(u1, u2, u3, u4, u5, u6, u7, q, inverse[m, e, wp.min(q, last)])
            _f, c, _less, j, square = deformed(h)
            g = shear[env] * wp.pow(j, power)
            # S = F^-1 P with F^-1 = cof(F)^T / J
            stress = (
                wp.identity(n=3, dtype=real) - (wp.transpose(c) * c) * (square * third / (j * j))
            ) * g
            for i in range(decay.shape[1]):
                branch_out[i, env, e, q] = (
                    branch_out[i, env, e, q] * decay[env, i]
                    + (stress - rest_out[env, e, q]) * gain[env, i]
                )
            rest_out[env, e, q] = stress
        _volume, theta, _lowest = mean_change(
            inverse, weight, m, e, points, u1, u2, u3, u4, u5, u6, u7
        )
        pressure = pressure_of(bulk[env], theta)
        for i in range(decay.shape[1]):
            bulk_branch_out[i, env, e] = (
                bulk_branch_out[i, env, e] * decay[env, i]
                + (pressure - bulk_rest_out[env, e]) * bulk_gain[env, i]
            )
        bulk_rest_out[env, e] = pressure

    return recall, keep


class Branches:
    """Prony branches of every Gauss point of a batch; up to 4 branches."""

    def __init__(self, real, scenes, elements: int, device: str) -> None:
        mat33 = matrix_of(real)
        series = [scene.effects.viscosity for scene in scenes]
        most = max(len(viscosity.ratios) for viscosity in series)
        count = len(scenes)
        self._ratios = np.zeros((count, most))
        self._times = np.ones((count, most))
        self._bulk = np.zeros((count, 1))
        for env, viscosity in enumerate(series):
            self._ratios[env, : len(viscosity.ratios)] = viscosity.ratios
            self._times[env, : len(viscosity.times)] = viscosity.times
            self._bulk[env] = viscosity.relaxes == "all"
        self._real, self._device = real, device
        self._shape = (count, elements)
        points = (count, elements, GAUSS_POINTS)
        self._branch = wp.zeros((most, *points), dtype=mat33, device=device)
        self._rest = wp.zeros(points, dtype=mat33, device=device)
        self._bulk_branch = wp.zeros((most, count, elements), dtype=real, device=device)
        self._bulk_rest = wp.zeros((count, elements), dtype=real, device=device)
        self.history = wp.zeros(points, dtype=mat33, device=device)
        """Stress that does not change within the step (B, E, 8) [E]."""
        self.bulk_history = wp.zeros((count, elements), dtype=real, device=device)
        """Pressure that does not change within the step (B, E) [E]."""
        self._decay = self._gain = self._bulk_gain = None

    @property
    def state(self) -> dict[str, wp.array]:
        """Stress at the end of the last step; the names of those by branch (N, B, ...) say so."""
        return {
            "branch": self._branch,
            "rest": self._rest,
            "bulk_branch": self._bulk_branch,
            "bulk_rest": self._bulk_rest,
        }

    def begin(self, active, duration: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Fill `history` of `active` environments for a step of `duration` (B,) [s].

        Returns:
            Factors on stress and pressure (B,) of all environments: for those that are not active,
            pass the duration of their current step.
        """
        fraction = np.maximum(duration, 1e-12)[:, None] / self._times
        gain = self._ratios * -np.expm1(-fraction) / fraction
        self._decay, self._gain = self._array(np.exp(-fraction)), self._array(gain)
        self._bulk_gain = self._array(gain * self._bulk)
        wp.launch(
            _kernels(self._real)[0],
            dim=self._shape,
            inputs=[
                self._decay,
                self._gain,
                self._bulk_gain,
                GAUSS_POINTS,
                self._branch,
                self._rest,
                self._bulk_branch,
                self._bulk_rest,
                active,
            ],
            outputs=[self.history, self.bulk_history],
            device=self._device,
        )
        return 1 + gain.sum(1), 1 + (gain * self._bulk).sum(1)

    def keep(self, mesh, material, active, u) -> None:
        """Store the state `u` of `active` environments as the end of the step.

        `mesh` is (elements, inverse, weight, variant), `material` (shear, bulk).
        """
        wp.launch(
            _kernels(self._real)[1],
            dim=self._shape,
            inputs=[
                *mesh,
                GAUSS_POINTS,
                *material,
                self._decay,
                self._gain,
                self._bulk_gain,
                active,
                u,
            ],
            outputs=[self._branch, self._rest, self._bulk_branch, self._bulk_rest],
            device=self._device,
        )

    def _array(self, values):
        return wp.array(
            np.ascontiguousarray(values, dtype=numpy_of(self._real)),
            dtype=self._real,
            device=self._device,
        )
