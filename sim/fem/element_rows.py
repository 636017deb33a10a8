# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""The tangent of an element, a row of 3x3 blocks a thread: what a GPU assembles.

The same blocks as `fem.element_blocks`, a row a thread: 8 blocks stay in registers. All 64 of an
element do not: a GPU's threads then wait for memory.

With A the reference derivatives of the shape function of the row's node, B those of a mode of the
other, and the rest as in `fem.element_blocks`, one Gauss point adds

    (A . metric B) 1 + e_A c_B^T + c_A e_B^T - skew(turn (A x B))

It is linear in B, so it is worked out for three directions; modes sum those over the Gauss points
as they do forces, and blocks are to modes as forces to theirs (`fem.element`). That takes some
65,000 operations an element; node by node it would be 90,000.
"""

import functools

import warp as wp

from sim.fem.element import column_function, mode_functions, nodal_function, strain_functions
from sim.fem.scalars import matrix_of, vector_of


@functools.cache
def element_rows_kernel(real, viscous: bool, full_integration: bool = False):
    """Kernel that adds elements' tangents to the stencils, no two of a launch sharing a node."""
    vec3 = vector_of(real)
    mat33 = matrix_of(real)
    modes_of, _scatter = mode_functions(real)
    column = column_function(real)
    blocks_of = nodal_function(real, mat33)
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
    def along(same: real, ea: vec3, c: vec3, ca: vec3, e: vec3, turned: vec3):
        """What one Gauss point adds between the row's node and a derivative along one direction."""
        straight = wp.identity(n=3, dtype=real) * same
        return straight + wp.outer(ea, c) + wp.outer(ca, e) - wp.skew(turned)

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

        # Blocks of the row and gradients of the volume, by modes of the other node, summed over
        # Gauss points as `fem.element` sums forces: names, because registers have no numbers.
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
            h, sx, sy, sz = strain(u1, u2, u3, u4, u5, u6, u7, q, inv)
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
            if wp.static(not full_integration):
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

        if wp.static(not full_integration):
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
