# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""The tangent of an element as 3x3 blocks between its nodes, added to the stencil of each node.

The derivative of the forces of `fem.element`, written out. With G_r = row r of the inverse
Jacobian, f_r = F G_r, c_r = cof(F) G_r and g = G J^(-2/3), the block between reference directions
r and s at one Gauss point is

    g (G_r.G_s) 1 - 2g/3J (f_r c_s^T + c_r f_s^T) + 5g |F|^2/9J^2 c_r c_s^T + (p - g |F|^2/3J) dcof

where dcof v = v x F(G_r x G_s); mean dilatation adds one product of vectors for each element.
The modes b = 1..7 of an element are products of reference coordinates, a bit each; the derivative
of mode b along r is mode b without bit r. So a block between modes is a sum of Walsh-Hadamard
coefficients, over the Gauss points, of the blocks above, and a second transform leads from modes to
nodes: about 10,000 operations an element, where 8 nodes times 8 points would take 40,000.
"""

import functools

import warp as wp

from sim.fem.element import column_function, mode_functions, strain_functions
from sim.fem.scalars import matrix_of, vector_of


@functools.cache
def element_blocks_kernel(real, viscous: bool, full_integration: bool = False):
    """Kernel that adds elements' tangents to the stencils, no two of a launch sharing a node.

    On the CPU, where threads run one after the other, a launch may hold every element.
    """
    vec3 = vector_of(real)
    mat33 = matrix_of(real)
    modes_of, _scatter = mode_functions(real)
    column = column_function(real)
    strain, cofactor, det_less_one = strain_functions(real)
    half, one, two = real(0.5), real(1.0), real(2.0)
    # Divided here: inside a kernel the quotient would be float32 whatever `real` is.
    third, power, five_thirds = real(1.0 / 3.0), real(-2.0 / 3.0), real(5.0 / 3.0)
    eighth, abscissa = real(0.125), real(0.5773502691896258)

    @wp.func
    def spread(bits: int):
        """Steps along x, y, z packed in 3 bits, as an offset in the 27 slots of a stencil."""
        return 9 * (bits >> 2) + 3 * ((bits >> 1) & 1) + (bits & 1)

    @wp.func
    def share(b: int):
        """Value of one corner in mode b, but for its sign, once its derivative is taken."""
        size = (b >> 2) + ((b >> 1) & 1) + (b & 1)
        value = eighth
        if size > 1:
            value = value * abscissa
        if size > 2:
            value = value * abscissa
        return value

    @wp.kernel(enable_backward=False, module="unique")
    def element_blocks(
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
        env, position = wp.tid()
        last = inverse.shape[2] - 1  # boxes have one Jacobian for all Gauss points
        if active[env] == 0:
            return
        e = order[first + position]
        kind = variant[env]
        u1, u2, u3, u4, u5, u6, u7 = modes_of(elements, u, env, e)
        # Blocks (r, s) in the order 00 11 22 01 02 12, and gradients of the volume, by Gauss
        # point; later by Walsh function.
        moments = wp.zeros(shape=(8, 6), dtype=mat33)
        means = wp.zeros(shape=(8, 3), dtype=vec3)
        # Blocks between modes; later between nodes.
        blocks = wp.zeros(shape=(8, 8), dtype=mat33)
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
            fr = f * across
            cr = cofactor(f) * across
            # Half of the c c^T term to either side makes it a product with its transpose.
            er = cr * (mixed * half) - fr * (w * two * over)
            metric = (inv * across) * (w * g)
            if wp.static(viscous):
                metric += (inv * history[env, e, q] * across) * w
            turning = w * (pressure - over * square)
            c0 = column(cr, 0)
            c1 = column(cr, 1)
            c2 = column(cr, 2)
            e0 = column(er, 0)
            e1 = column(er, 1)
            e2 = column(er, 2)
            # F (G_1 x G_2), F (G_2 x G_0), F (G_0 x G_1), times what turns them
            turn = f * wp.transpose(cofactor(inv)) * turning
            moments[q, 0] = wp.outer(e0, c0) + wp.outer(c0, e0) + identity * metric[0, 0]
            moments[q, 1] = wp.outer(e1, c1) + wp.outer(c1, e1) + identity * metric[1, 1]
            moments[q, 2] = wp.outer(e2, c2) + wp.outer(c2, e2) + identity * metric[2, 2]
            moments[q, 3] = (
                wp.outer(e0, c1)
                + wp.outer(c0, e1)
                + identity * metric[0, 1]
                - wp.skew(column(turn, 2))
            )
            moments[q, 4] = (
                wp.outer(e0, c2)
                + wp.outer(c0, e2)
                + identity * metric[0, 2]
                + wp.skew(column(turn, 1))
            )
            moments[q, 5] = (
                wp.outer(e1, c2)
                + wp.outer(c1, e2)
                + identity * metric[1, 2]
                - wp.skew(column(turn, 0))
            )
            means[q, 0] = c0 * w
            means[q, 1] = c1 * w
            means[q, 2] = c2 * w

        # Walsh-Hadamard transform over the Gauss points
        for axis in range(3):
            bit = 1 << axis
            for low in range(corners):
                if low & bit == 0:
                    for k in range(6):
                        one_block = moments[low, k]
                        other_block = moments[low + bit, k]
                        moments[low, k] = one_block + other_block
                        moments[low + bit, k] = other_block - one_block
                    for k in range(3):
                        one_mean = means[low, k]
                        other_mean = means[low + bit, k]
                        means[low, k] = one_mean + other_mean
                        means[low + bit, k] = other_mean - one_mean

        # Blocks between modes a <= b
        for a in range(1, corners):
            mean_a = vec3()
            for r in range(3):
                if (a >> (2 - r)) & 1 == 1:
                    mean_a += means[a ^ (4 >> r), r]
            for b in range(a, corners):
                mean_b = vec3()
                block = mat33()
                for s in range(3):
                    if (b >> (2 - s)) & 1 == 1:
                        without = b ^ (4 >> s)
                        mean_b += means[without, s]
                        for r in range(3):
                            if (a >> (2 - r)) & 1 == 1:
                                walsh = without ^ a ^ (4 >> r)
                                if r == s:
                                    block += moments[walsh, r]
                                elif r < s:
                                    block += moments[walsh, r + s + 2]
                                else:
                                    block += wp.transpose(moments[walsh, r + s + 2])
                if wp.static(not full_integration):
                    block += wp.outer(mean_a * stiffness, mean_b)
                block = block * (share(a) * share(b))
                blocks[a, b] = block
                if a != b:
                    blocks[b, a] = wp.transpose(block)

        # Transform back, first the rows to nodes, then the columns
        for axis in range(3):
            bit = 1 << axis
            for low in range(corners):
                if low & bit == 0:
                    for b in range(1, corners):
                        one_block = blocks[low, b]
                        other_block = blocks[low + bit, b]
                        blocks[low, b] = one_block - other_block
                        blocks[low + bit, b] = one_block + other_block
        for axis in range(3):
            bit = 1 << axis
            for low in range(corners):
                if low & bit == 0:
                    for a in range(corners):
                        one_block = blocks[a, low]
                        other_block = blocks[a, low + bit]
                        blocks[a, low] = one_block - other_block
                        blocks[a, low + bit] = one_block + other_block
        for a in range(corners):
            n = elements[e, a]
            if free[n] == 1:
                own = 13 - spread(a)
                for b in range(corners):
                    if free[elements[e, b]] == 1:
                        slot = own + spread(b)
                        matrix_out[env, n, slot] = matrix_out[env, n, slot] + blocks[a, b]

    return element_blocks
