# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""The tangent of an element, a row of 3x3 blocks a thread: what a GPU assembles.

The same blocks as `fem.element_blocks`, summed over Gauss points from node to node instead of by
transforms. That takes some 90,000 operations an element, ten times as many; but a row is 8 blocks,
which stay in registers. All 64 of an element do not: a GPU's threads then wait for memory.

With A and B the reference derivatives of the shape functions of two nodes, and the rest as in
`fem.element_blocks`, the block between them at one Gauss point is

    (A . metric B) 1 + e_A c_B^T + c_A e_B^T - skew(turn (A x B))
"""

import functools

import warp as wp

from sim.fem.element import mode_functions, strain_functions
from sim.fem.scalars import matrix_of, vector_of


@functools.cache
def element_rows_kernel(real, viscous: bool, full_integration: bool = False):
    """Kernel that adds elements' tangents to the stencils, no two of a launch sharing a node."""
    vec3 = vector_of(real)
    mat33 = matrix_of(real)
    modes_of, _scatter = mode_functions(real)
    strain, cofactor, det_less_one = strain_functions(real)
    half, one, two = real(0.5), real(1.0), real(2.0)
    # Divided here: inside a kernel the quotient would be float32 whatever `real` is.
    third, power, five_thirds = real(1.0 / 3.0), real(-2.0 / 3.0), real(5.0 / 3.0)
    near, far = real(0.5 + 0.5 / 3.0**0.5), real(0.5 - 0.5 / 3.0**0.5)

    @wp.func
    def slope(q: int, b: int):
        """Derivatives of corner b's shape function at Gauss point q, in reference coordinates."""
        apart = q ^ b
        x = wp.where((apart >> 2) & 1 == 0, near, far)
        y = wp.where((apart >> 1) & 1 == 0, near, far)
        z = wp.where(apart & 1 == 0, near, far)
        along_x = wp.where((b >> 2) & 1 == 1, half, -half)
        along_y = wp.where((b >> 1) & 1 == 1, half, -half)
        along_z = wp.where(b & 1 == 1, half, -half)
        return vec3(along_x * y * z, along_y * x * z, along_z * x * y)

    @wp.func
    def block(a: vec3, b: vec3, ma: vec3, ca: vec3, ea: vec3, cb: vec3, er: mat33, turn: mat33):
        """What one Gauss point adds between the nodes whose derivatives are a and b."""
        same = wp.identity(n=3, dtype=real) * wp.dot(ma, b)
        return same + wp.outer(ea, cb) + wp.outer(ca, er * b) - wp.skew(turn * wp.cross(a, b))

    @wp.func
    def spread(bits: int):
        """Steps along x, y, z packed in 3 bits, as an offset in the 27 slots of a stencil."""
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
        # Mesh, by variant; which elements, from where on, and which nodes move
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
        u1, u2, u3, u4, u5, u6, u7 = modes_of(elements, u, env, e)
        identity = wp.identity(n=3, dtype=real)

        volume = real(0.0)
        change = real(0.0)
        for q in range(corners):
            h, _sx, _sy, _sz = strain(
                u1, u2, u3, u4, u5, u6, u7, q, inverse[kind, e, wp.min(q, last)]
            )
            volume += weight[kind, e, q]
            change += weight[kind, e, q] * det_less_one(h)
        theta = change / volume
        pressure = half * bulk[env] * theta * (two + theta) / (one + theta)
        stiffness = half * bulk[env] * (one + one / ((one + theta) * (one + theta)))
        if wp.static(viscous):
            pressure = bulk_factor[env] * pressure + bulk_history[env, e]
            stiffness = bulk_factor[env] * stiffness
        stiffness = stiffness / volume

        # Blocks of the row, and gradients of the volume: names, because registers have no numbers.
        k0 = mat33()
        k1 = mat33()
        k2 = mat33()
        k3 = mat33()
        k4 = mat33()
        k5 = mat33()
        k6 = mat33()
        k7 = mat33()
        m0 = vec3()
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
            h, _sx, _sy, _sz = strain(u1, u2, u3, u4, u5, u6, u7, q, inv)
            f = h + identity
            less = det_less_one(h)
            j = one + less
            w = weight[kind, e, q]
            g = shear[env] * wp.pow(j, power)
            if wp.static(viscous):
                g = g * factor[env]
            if wp.static(full_integration):
                pressure = half * bulk[env] * less * (two + less) / j
            over = g * third / j
            square = wp.ddot(f, f)
            mixed = w * over * five_thirds * square / j
            if wp.static(full_integration):
                mixed += w * half * bulk[env] * (one + one / (j * j))
            across = wp.transpose(inv)
            cr = cofactor(f) * across
            # Half of the c c^T term to either side makes it a product with its transpose.
            er = cr * (mixed * half) - (f * across) * (w * two * over)
            metric = (inv * across) * (w * g)
            if wp.static(viscous):
                metric += (inv * history[env, e, q] * across) * w
            # F (G_1 x G_2), F (G_2 x G_0), F (G_0 x G_1), times what turns them
            turn = f * wp.transpose(cofactor(inv)) * (w * (pressure - over * square))
            sa = slope(q, a)
            ma = wp.transpose(metric) * sa
            ca = cr * sa
            ea = er * sa
            mean += ca * w
            s0 = slope(q, 0)
            c0 = cr * s0
            k0 += block(sa, s0, ma, ca, ea, c0, er, turn)
            m0 += c0 * w
            s1 = slope(q, 1)
            c1 = cr * s1
            k1 += block(sa, s1, ma, ca, ea, c1, er, turn)
            m1 += c1 * w
            s2 = slope(q, 2)
            c2 = cr * s2
            k2 += block(sa, s2, ma, ca, ea, c2, er, turn)
            m2 += c2 * w
            s3 = slope(q, 3)
            c3 = cr * s3
            k3 += block(sa, s3, ma, ca, ea, c3, er, turn)
            m3 += c3 * w
            s4 = slope(q, 4)
            c4 = cr * s4
            k4 += block(sa, s4, ma, ca, ea, c4, er, turn)
            m4 += c4 * w
            s5 = slope(q, 5)
            c5 = cr * s5
            k5 += block(sa, s5, ma, ca, ea, c5, er, turn)
            m5 += c5 * w
            s6 = slope(q, 6)
            c6 = cr * s6
            k6 += block(sa, s6, ma, ca, ea, c6, er, turn)
            m6 += c6 * w
            s7 = slope(q, 7)
            c7 = cr * s7
            k7 += block(sa, s7, ma, ca, ea, c7, er, turn)
            m7 += c7 * w

        if wp.static(not full_integration):
            mean = mean * stiffness
            k0 += wp.outer(mean, m0)
            k1 += wp.outer(mean, m1)
            k2 += wp.outer(mean, m2)
            k3 += wp.outer(mean, m3)
            k4 += wp.outer(mean, m4)
            k5 += wp.outer(mean, m5)
            k6 += wp.outer(mean, m6)
            k7 += wp.outer(mean, m7)
        add(elements, free, env, e, a, 0, k0, matrix_out)
        add(elements, free, env, e, a, 1, k1, matrix_out)
        add(elements, free, env, e, a, 2, k2, matrix_out)
        add(elements, free, env, e, a, 3, k3, matrix_out)
        add(elements, free, env, e, a, 4, k4, matrix_out)
        add(elements, free, env, e, a, 5, k5, matrix_out)
        add(elements, free, env, e, a, 6, k6, matrix_out)
        add(elements, free, env, e, a, 7, k7, matrix_out)

    return element_rows
