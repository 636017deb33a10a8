# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Elastic and viscous forces of 8-node hexahedra with mean dilatation, and their tangents.

Isochoric neo-Hookean with one volume change theta per element (Simo, Taylor & Pister 1985):
W = G/2 (J^(-2/3) tr(F^T F) - 3) + K/2 ((theta^2 - 1)/2 - ln theta), theta = deformed/rest volume.
Full displacement elements lock near nu = 0.5; these do not.

With `Fem.stiffening` c another term, G c/4 max(I - `STIFF_FROM`, 0)^2 of the isochoric invariant
I = J^(-2/3) tr(F^T F), multiplies shear stresses by 1 + c (I - `STIFF_FROM`), as real silicone
stiffens at large strain. A neo-Hookean surface that is compressed along one direction by about
45 % has no smooth state (Biot 1963), and so it folds beside sharp edges.

The displacement of an element is written in the 7 modes xi, eta, zeta, xi eta, eta zeta, xi zeta,
xi eta zeta (its Walsh-Hadamard transform), whose gradients at the Gauss points are signed sums:
less than half the arithmetic of 8 nodes times 8 points. All quantities are in units of the body's
thickness and modulus, with one thread per element of each environment. GPUs use these kernels, and
CPUs those of `sim.fem.lanes`.
"""

import functools

import numpy as np
import warp as wp
from numpy.typing import NDArray

from sim.device import kernel
from sim.fem.arrays import array_of, copy_active, material_struct, mesh_struct
from sim.scalars import det_less_one_function, matrix_of, numpy_of, vector_of

GAUSS_POINTS = 8
# Threads per block that assemble rows of elements: for all tangents of 162 presses an H200 takes
# 0.49 s, with blocks of 256 0.54 s.
ROWS_BLOCK = 64
# Isochoric invariant at which the stiffening of `Fem.stiffening` begins: 3 at rest, and 4 at 67 %
# of stretch or 46 % of compression. Under a cone 1.2 mm deep in 4 mm of gel, forces of two such
# skins differ by 6 %, and by 24 % if both begin at 3.5.
STIFF_FROM = 4.0


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
def mode_functions(real, kind):
    """Return the struct of 7 modes, vectors or matrices, and the functions `gathered`, `corners`.

    `gathered(modes, x, y, z, sx, sy, sz)` adds derivatives along the reference directions, at the
    Gauss point whose coordinates have these signs. `corners` is `modes_function`'s transpose.
    """
    eighth = real(0.125)
    g = real(0.5773502691896258)
    gg = real(1.0 / 3.0)

    class Modes:
        x: kind
        y: kind
        z: kind
        xy: kind
        yz: kind
        xz: kind
        xyz: kind

    modes_type = wp.struct(Modes)

    @wp.func
    def gathered(m: modes_type, x: kind, y: kind, z: kind, sx: real, sy: real, sz: real):
        m.x += x
        m.y += y
        m.z += z
        m.xy += x * sy + y * sx
        m.yz += y * sz + z * sy
        m.xz += x * sz + z * sx
        m.xyz += x * (sy * sz) + y * (sx * sz) + z * (sx * sy)
        return m

    @wp.func
    def corners(m: modes_type):
        a1 = m.x * eighth
        a2 = m.y * eighth
        a3 = m.z * eighth
        a4 = m.xy * (eighth * g)
        a5 = m.yz * (eighth * g)
        a6 = m.xz * (eighth * g)
        a7 = m.xyz * (eighth * gg)
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

    return modes_type, gathered, corners


@functools.cache
def modes_function(real):
    """Return `modes_of(elements, u, env, e)`: the modes of an element's displacement."""
    vec3 = vector_of(real)
    eighth = real(0.125)
    g = real(0.5773502691896258)
    gg = real(1.0 / 3.0)
    modes_type = mode_functions(real, vec3)[0]

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
        m = modes_type()
        m.x = ((s45 + s67) - (s01 + s23)) * eighth
        m.y = ((s23 - s01) + (s67 - s45)) * eighth
        m.z = ((d01 + d23) + (d45 + d67)) * eighth
        m.xy = ((s67 - s45) - (s23 - s01)) * (eighth * g)
        m.yz = ((d23 - d01) + (d67 - d45)) * (eighth * g)
        m.xz = ((d45 + d67) - (d01 + d23)) * (eighth * g)
        m.xyz = ((d67 - d45) - (d23 - d01)) * (eighth * gg)
        return m

    return modes_of


@functools.cache
def kinematics(real):
    """Return the shared `strain`, `cofactor`, `deformed`, `mean_change` and `pressure_of`."""
    modes_type = mode_functions(real, vector_of(real))[0]
    mat33 = matrix_of(real)
    half, one, two = real(0.5), real(1.0), real(2.0)

    @wp.func
    def strain(m: modes_type, q: int, inv: mat33):
        """Return the displacement gradient at Gauss point q, and the signs of its coordinates."""
        sx = real(2 * (q >> 2) - 1)
        sy = real(2 * ((q >> 1) & 1) - 1)
        sz = real(2 * (q & 1) - 1)
        gx = m.x + m.xy * sy + m.xz * sz + m.xyz * (sy * sz)
        gy = m.y + m.xy * sx + m.yz * sz + m.xyz * (sx * sz)
        gz = m.z + m.yz * sy + m.xz * sx + m.xyz * (sx * sy)
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
    def mean_change(mesh: mesh_struct(real), m: int, e: int, u: modes_type):
        """Return an element's rest volume, mean volume change, and least J at its Gauss points."""
        last = mesh.inverse.shape[2] - 1  # boxes have one Jacobian for all Gauss points
        volume = real(0.0)
        change = real(0.0)
        lowest = real(1.0e30)
        for q in range(mesh.weight.shape[2]):
            h, _sx, _sy, _sz = strain(u, q, mesh.inverse[m, e, wp.min(q, last)])
            less = det_less_one(h)
            volume += mesh.weight[m, e, q]
            change += mesh.weight[m, e, q] * less
            lowest = wp.min(lowest, one + less)
        return volume, change / volume, lowest

    @wp.func
    def pressure_of(bulk: real, theta: real):
        """Return the derivative of the energy by the volume, at the mean change of volume."""
        return half * bulk * theta * (two + theta) / (one + theta)

    return strain, cofactor, deformed, mean_change, pressure_of


# At small strain energies are summed by their series, without the cancellation of terms of first
# order that would leave float32 nothing of a light touch.

# Changes of volume below which, so that both ways have the fewest errors.
SMALL = {wp.float32: 0.05, wp.float64: 1e-3}


@functools.cache
def energy_functions(real):
    """Return the energies per volume, as functions of strains of any size.

    `of_volume(theta)` is over half the bulk modulus, and `of_shape(less, trace, norm, power)` over
    half the shear modulus: from J - 1, trace and square of the norm of the gradient, and J^(-2/3).
    """
    half, one, two, three = real(0.5), real(1.0), real(2.0), real(3.0)
    small, third, fourth, fifth = real(SMALL[real]), real(1.0 / 3.0), real(0.25), real(0.2)
    cubic, quintic = real(10.0 / 27.0), real(88.0 / 243.0)
    tiny = real(1.0e-30)

    @wp.func
    def of_volume(theta: real):
        if wp.abs(theta) < small:
            return theta * theta * (one - theta * (third - theta * (fourth - theta * fifth)))
        return half * theta * (two + theta) - wp.log(wp.max(one + theta, tiny))

    @wp.func
    def of_shape(less: real, trace: real, norm: real, power: real):
        changed = power * (three + two * less) - three
        if wp.abs(less) < small:
            changed = less * less * (third - less * (cubic - less * (cubic - less * quintic)))
        return power * (norm + two * (trace - less)) + changed

    return of_volume, of_shape


@functools.cache
def stiffening_functions(real):
    """Return `beyond` and `stretching`, of skin that stiffens."""
    mat33 = matrix_of(real)
    deformed = kinematics(real)[2]
    third, power, least = real(1.0 / 3.0), real(-2.0 / 3.0), real(STIFF_FROM)
    zero, two = real(0.0), real(2.0)

    @wp.func
    def beyond(smaller: real, square: real):
        """Return how far I = J^(-2/3) |F|^2 is beyond the beginning."""
        return wp.max(smaller * square - least, zero)

    @wp.func
    def stretching(h: mat33, inv: mat33, stiffness: real):
        """Return the derivatives d_r of I along the reference directions, as columns.

        They are times the square root of `stiffness`, half of its second derivative of the energy,
        and so add d_r d_s^T to the tangent.
        """
        f, c, _less, j, square = deformed(h)
        across = wp.transpose(inv)
        smaller = wp.pow(j, power)
        slope = (f * across - (c * across) * (square * third / j)) * (two * smaller)
        on = wp.where(beyond(smaller, square) > zero, stiffness, zero)
        return slope * wp.sqrt(on)

    return beyond, stretching


@functools.cache
def element_kernels(real, viscous: bool, split: bool = False, stiffening: bool = False):
    """Return the kernel of the forces for one precision and combination of effects.

    `viscous` compiles the Prony history in, `split` that of the pressure alone (`VolumePressure`),
    `stiffening` that of the skin; without them none of that code is compiled.
    """
    beyond = stiffening_functions(real)[0]
    vec3 = vector_of(real)
    modes_type, gathered, corners = mode_functions(real, vec3)
    modes_of, column = modes_function(real), column_function(real)
    strain, cofactor, deformed, mean_change, pressure_of = kinematics(real)
    of_volume, of_shape = energy_functions(real)
    half, two, three = real(0.5), real(2.0), real(3.0)
    third = real(1.0 / 3.0)
    # Divided here: inside a kernel the quotient would be float32 for any `real`.
    power = real(-2.0 / 3.0)

    @kernel()
    def residual(
        mesh: mesh_struct(real),
        material: material_struct(real),
        active: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
        # Out:
        force_out: wp.array3d(dtype=vec3),
        energy_out: wp.array2d(dtype=real),
        det_out: wp.array2d(dtype=real),
    ):
        env, e = wp.tid()
        last = mesh.inverse.shape[2] - 1  # boxes have one Jacobian for all Gauss points
        if active[env] == 0:
            return
        m = mesh.variant[env]
        if mesh.weight[m, e, 0] == real(0.0):  # outside a round body
            return
        moved = modes_of(mesh.elements, u, env, e)
        volume, theta, lowest = mean_change(mesh, m, e, moved)
        det_out[env, e] = lowest
        shear = material.shear[env]
        bulk = material.bulk[env]
        pressure = pressure_of(bulk, theta)
        energy = volume * half * bulk * of_volume(theta)
        if wp.static(viscous or split):
            pressure = material.bulk_factor[env] * pressure + material.bulk_history[env, e]
        total = modes_type()
        for q in range(mesh.weight.shape[2]):
            inv = mesh.inverse[m, e, wp.min(q, last)]
            h, sx, sy, sz = strain(moved, q, inv)
            f, c, less, j, square = deformed(h)
            w = mesh.weight[m, e, q]
            smaller = wp.pow(wp.max(j, real(1.0e-30)), power)
            g = shear * smaller
            if wp.static(stiffening):
                more = material.stiffening[env] * beyond(smaller, square)
                g = g * (real(1.0) + more)
                energy += w * half * half * shear * more * beyond(smaller, square)
            # F - cof(F) tr(F^T F) / 3J in terms of h = F - 1: no cancellation at small strain
            trace = wp.trace(h)
            norm = wp.ddot(h, h)
            energy += w * half * shear * of_shape(less, trace, norm, smaller)
            excess = (two * trace + norm - three * less) * (third / j)
            stress = h + wp.transpose(h) - cofactor(h) - c * excess
            stress = (stress - wp.identity(n=3, dtype=real) * trace) * g
            if wp.static(viscous):
                stress = stress * material.factor[env] + f * material.history[env, e, q]
            stress = (stress + c * pressure) * w
            t = stress * wp.transpose(inv)
            total = gathered(total, column(t, 0), column(t, 1), column(t, 2), sx, sy, sz)
        energy_out[env, e] = energy
        v0, v1, v2, v3, v4, v5, v6, v7 = corners(total)
        force_out[env, e, 0] = v0
        force_out[env, e, 1] = v1
        force_out[env, e, 2] = v2
        force_out[env, e, 3] = v3
        force_out[env, e, 4] = v4
        force_out[env, e, 5] = v5
        force_out[env, e, 6] = v6
        force_out[env, e, 7] = v7

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
def tangent_functions(real, viscous: bool, split: bool = False, stiffening: bool = False):
    """Return `of_mean` and `at_point`, of an element and of its Gauss points.

    Arguments as in `element_kernels`. The part by the derivative of I is `stretching`.
    """
    beyond = stiffening_functions(real)[0]
    mat33 = matrix_of(real)
    modes_type = mode_functions(real, vector_of(real))[0]
    _strain, cofactor, deformed, mean_change, pressure_of = kinematics(real)
    half, one, two = real(0.5), real(1.0), real(2.0)
    # Divided here: inside a kernel the quotient would be float32 for any `real`.
    third, power, five_thirds = real(1.0 / 3.0), real(-2.0 / 3.0), real(5.0 / 3.0)

    @wp.func
    def of_mean(
        mesh: mesh_struct(real), material: material_struct(real), env: int, e: int, u: modes_type
    ):
        """Return an element's pressure, and its derivative by mean volume change, per volume."""
        volume, theta, _lowest = mean_change(mesh, mesh.variant[env], e, u)
        bulk = material.bulk[env]
        pressure = pressure_of(bulk, theta)
        stiffness = half * bulk * (one + one / ((one + theta) * (one + theta)))
        if wp.static(viscous or split):
            pressure = material.bulk_factor[env] * pressure + material.bulk_history[env, e]
            stiffness = material.bulk_factor[env] * stiffness
        return pressure, stiffness / volume

    @wp.func
    def at_point(
        h: mat33,
        inv: mat33,
        w: real,
        pressure: real,
        material: material_struct(real),
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
        g = material.shear[env] * wp.pow(j, power)
        if wp.static(stiffening):
            g = g * (one + material.stiffening[env] * beyond(wp.pow(j, power), square))
        if wp.static(viscous):
            g = g * material.factor[env]
        over = g * third / j
        mixed = w * over * five_thirds * square / j
        across = wp.transpose(inv)
        cr = c * across
        # Half of the c c^T term on either side makes it a product with its transpose.
        er = cr * (mixed * half) - (f * across) * (w * two * over)
        metric = (inv * across) * (w * g)
        if wp.static(viscous):
            metric += (inv * material.history[env, e, q] * across) * w
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
# It is linear in B, so it is computed for three directions. Modes sum those over the Gauss points,
# and become blocks, as they do forces. It takes about 65,000 operations an element; node by node it
# would be 90,000.


@functools.cache
def element_rows_kernel(real, viscous: bool, split: bool = False, stiffening: bool = False):
    """Return the kernel that adds tangents by rows; no two elements of a launch share a node."""
    stretching = stiffening_functions(real)[1]
    vec3 = vector_of(real)
    mat33 = matrix_of(real)
    modes_of, column = modes_function(real), column_function(real)
    modes_type, gathered, _corners = mode_functions(real, vec3)
    blocks_type, gathered_blocks, blocks_of = mode_functions(real, mat33)
    strain = kinematics(real)[0]
    of_mean, at_point = tangent_functions(real, viscous, split, stiffening)
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
        mesh: mesh_struct(real),
        env: int,
        e: int,
        a: int,
        b: int,
        block: mat33,
        matrix_out: wp.array3d(dtype=mat33),
    ):
        if mesh.free[mesh.elements[e, b]] == 1:
            n = mesh.elements[e, a]
            slot = 13 - spread(a) + spread(b)
            matrix_out[env, n, slot] = matrix_out[env, n, slot] + block

    @kernel(block=ROWS_BLOCK)
    def element_rows(
        mesh: mesh_struct(real),
        material: material_struct(real),
        # Order of the elements, and the first one of the launch
        order: wp.array(dtype=wp.int32),
        first: int,
        active: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
        convex: wp.array(dtype=wp.int32),
        # In and out:
        matrix_out: wp.array3d(dtype=mat33),
    ):
        env, a, position = wp.tid()
        last = mesh.inverse.shape[2] - 1  # boxes have one Jacobian for all Gauss points
        if active[env] == 0:
            return
        e = order[first + position]
        if mesh.free[mesh.elements[e, a]] == 0:
            return
        kind = mesh.variant[env]
        if mesh.weight[kind, e, 0] == real(0.0):  # outside a round body
            return
        moved = modes_of(mesh.elements, u, env, e)
        pressure, stiffness = of_mean(mesh, material, env, e, moved)

        # Blocks of the row and gradients of the volume, by modes of the other node, summed over
        # Gauss points as the forces are. No arrays, because registers cannot be indexed.
        k = blocks_type()
        m = modes_type()
        mean = vec3()
        for q in range(mesh.weight.shape[2]):
            inv = mesh.inverse[kind, e, wp.min(q, last)]
            w = mesh.weight[kind, e, q]
            h, sx, sy, sz = strain(moved, q, inv)
            cr, er, metric, turn = at_point(h, inv, w, pressure, material, convex[env], env, e, q)
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
            if wp.static(stiffening):
                bend = half * material.stiffening[env] * material.shear[env] * w
                if wp.static(viscous):
                    bend = bend * material.factor[env]
                dr = stretching(h, inv, bend)
                da = dr * sa
                bx += wp.outer(da, column(dr, 0))
                by += wp.outer(da, column(dr, 1))
                bz += wp.outer(da, column(dr, 2))
            k = gathered_blocks(k, bx, by, bz, sx, sy, sz)
            mean += ca * w
            m = gathered(m, cx * w, cy * w, cz * w, sx, sy, sz)

        # The product with the mean of all volume changes is linear in the modes as well.
        mean = mean * stiffness
        k.x += wp.outer(mean, m.x)
        k.y += wp.outer(mean, m.y)
        k.z += wp.outer(mean, m.z)
        k.xy += wp.outer(mean, m.xy)
        k.yz += wp.outer(mean, m.yz)
        k.xz += wp.outer(mean, m.xz)
        k.xyz += wp.outer(mean, m.xyz)
        b0, b1, b2, b3, b4, b5, b6, b7 = blocks_of(k)
        add(mesh, env, e, a, 0, b0, matrix_out)
        add(mesh, env, e, a, 1, b1, matrix_out)
        add(mesh, env, e, a, 2, b2, matrix_out)
        add(mesh, env, e, a, 3, b3, matrix_out)
        add(mesh, env, e, a, 4, b4, matrix_out)
        add(mesh, env, e, a, 5, b5, matrix_out)
        add(mesh, env, e, a, 6, b6, matrix_out)
        add(mesh, env, e, a, 7, b7, matrix_out)

    return element_rows


# Prony branches at the Gauss points: their stored stresses, and the change over a step.
#
# Simo & Hughes, Computational Inelasticity (1998), section 10.3: the stress of branch i after a
# step dt is h = exp(-dt/time) h_old + ratio a (S - S_old) with a = (1 - exp(-dt/time)) time / dt, S
# the second Piola-Kirchhoff stress at rest. So within a step the stress is S (1 + sum ratio a) +
# history, where history = sum(exp(-dt/time) h_old) - sum(ratio a) S_old does not change. Element
# kernels need nothing else. The pressure of an element relaxes in the same way.


@functools.cache
def branches_struct(real):
    """Return the struct of Prony branches: rates (B, branches), and stresses and pressures."""
    mat33 = matrix_of(real)

    class Prony:
        decay: wp.array2d(dtype=real)
        gain: wp.array2d(dtype=real)
        bulk_gain: wp.array2d(dtype=real)
        branch: wp.array4d(dtype=mat33)  # (branches, B, E, 8)
        rest: wp.array3d(dtype=mat33)
        bulk_branch: wp.array3d(dtype=real)  # (branches, B, E)
        bulk_rest: wp.array2d(dtype=real)
        history: wp.array3d(dtype=mat33)  # what does not change within the step
        bulk_history: wp.array2d(dtype=real)

    return wp.struct(Prony)


@functools.cache
def _kernels(real, stiffening: bool):
    vec3 = vector_of(real)
    mat33 = matrix_of(real)
    modes_of = modes_function(real)
    strain, _cofactor, deformed, mean_change, pressure_of = kinematics(real)
    beyond = stiffening_functions(real)[0]
    third = real(1.0 / 3.0)
    power = real(-2.0 / 3.0)

    @kernel()
    def recall(prony: branches_struct(real), active: wp.array(dtype=wp.int32)):
        env, e = wp.tid()
        if active[env] == 0:
            return
        for q in range(prony.rest.shape[2]):
            history = mat33()
            for i in range(prony.decay.shape[1]):
                history += (
                    prony.branch[i, env, e, q] * prony.decay[env, i]
                    - prony.rest[env, e, q] * prony.gain[env, i]
                )
            prony.history[env, e, q] = history
        bulk_history = real(0.0)
        for i in range(prony.decay.shape[1]):
            bulk_history += (
                prony.bulk_branch[i, env, e] * prony.decay[env, i]
                - prony.bulk_rest[env, e] * prony.bulk_gain[env, i]
            )
        prony.bulk_history[env, e] = bulk_history

    @kernel()
    def keep(
        mesh: mesh_struct(real),
        material: material_struct(real),
        prony: branches_struct(real),
        active: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
    ):
        env, e = wp.tid()
        last = mesh.inverse.shape[2] - 1  # boxes have one Jacobian for all Gauss points
        if active[env] == 0:
            return
        m = mesh.variant[env]
        if mesh.weight[m, e, 0] == real(0.0):  # outside a round body
            return
        moved = modes_of(mesh.elements, u, env, e)
        for q in range(mesh.weight.shape[2]):
            h, _sx, _sy, _sz = strain(moved, q, mesh.inverse[m, e, wp.min(q, last)])
            _f, c, _less, j, square = deformed(h)
            g = material.shear[env] * wp.pow(j, power)
            if wp.static(stiffening):
                g *= real(1.0) + material.stiffening[env] * beyond(wp.pow(j, power), square)
            # S = F^-1 P with F^-1 = cof(F)^T / J
            stress = (
                wp.identity(n=3, dtype=real) - (wp.transpose(c) * c) * (square * third / (j * j))
            ) * g
            for i in range(prony.decay.shape[1]):
                prony.branch[i, env, e, q] = (
                    prony.branch[i, env, e, q] * prony.decay[env, i]
                    + (stress - prony.rest[env, e, q]) * prony.gain[env, i]
                )
            prony.rest[env, e, q] = stress
        _volume, theta, _lowest = mean_change(mesh, m, e, moved)
        pressure = pressure_of(material.bulk[env], theta)
        for i in range(prony.decay.shape[1]):
            prony.bulk_branch[i, env, e] = (
                prony.bulk_branch[i, env, e] * prony.decay[env, i]
                + (pressure - prony.bulk_rest[env, e]) * prony.bulk_gain[env, i]
            )
        prony.bulk_rest[env, e] = pressure

    return recall, keep


class Branches:
    """Prony branches of every Gauss point of a batch; up to 4 branches."""

    def __init__(self, real, scenes, elements: int, device: str, *, stiffening=False) -> None:
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
        self._recall, self._keep = _kernels(real, stiffening)
        self._shape = (count, elements)
        points = (count, elements, GAUSS_POINTS)
        arrays = self.arrays = branches_struct(real)()
        """Arrays of the kernels. `history` (B, E, 8) and `bulk_history` (B, E), stress and pressure
        [E], do not change within the step."""
        arrays.branch = wp.zeros((most, *points), dtype=mat33, device=device)
        arrays.rest = wp.zeros(points, dtype=mat33, device=device)
        arrays.bulk_branch = wp.zeros((most, count, elements), dtype=real, device=device)
        arrays.bulk_rest = wp.zeros((count, elements), dtype=real, device=device)
        arrays.history = wp.zeros(points, dtype=mat33, device=device)
        arrays.bulk_history = wp.zeros((count, elements), dtype=real, device=device)

    @property
    def state(self) -> dict[str, wp.array]:
        """Stress at the end of the last step; the names of those by branch (N, B, ...) say so."""
        names = "branch", "rest", "bulk_branch", "bulk_rest"
        return {name: getattr(self.arrays, name) for name in names}

    def begin(self, active, duration: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Fill `history` of `active` environments for a step of `duration` (B,) [s].

        Returns:
            Factors on stress and pressure (B,) of all environments: for those that are not active,
            pass the duration of their current step.
        """
        fraction = np.maximum(duration, 1e-12)[:, None] / self._times
        gain = self._ratios * -np.expm1(-fraction) / fraction
        for name, rates in (
            ("decay", np.exp(-fraction)),
            ("gain", gain),
            ("bulk_gain", gain * self._bulk),
        ):
            setattr(self.arrays, name, array_of(rates, self._real, self._real, self._device))
        self._launch(self._recall, [self.arrays, active])
        return 1 + gain.sum(1), 1 + (gain * self._bulk).sum(1)

    def keep(self, mesh, material, active, u) -> None:
        """Store the state `u` of `active` environments as the end of the step."""
        self._launch(self._keep, [mesh, material, self.arrays, active, u])

    def _launch(self, one, inputs) -> None:
        wp.launch(one, self._shape, inputs, device=self._device)


# Nearly incompressible bodies: the pressure of each element follows its volume step by step.
#
# Close to a Poisson's ratio of 0.5 a body resists changes of volume hundreds of times as much as
# shear. Its tangent is then so hard to solve that each of Newton's iterations takes 60 to 140
# cycles of the preconditioner, where 10 to 20 are enough at 0.49.
#
# So the pressure is split, as that of contact is (`sim.fem.contact`): a fraction follows the volume
# within a solve, with the stiffness of a Poisson's ratio of 0.47, and the rest is what the whole
# was before. Once a state is balanced, the rest is set to its fraction of the new pressure, and the
# state solved again, until that no longer disturbs the balance (augmented Lagrangian method; Simo &
# Taylor, Comput. Methods Appl. Mech. Eng. 85, 1991). The solution is that of the whole stiffness.
# Pressures that alternate from element to element hardly move anything and settle slowly; so the
# fraction that follows grows after every few settlings, up to the whole.
#
# An element's pressure depends on its volume through the material's law p(theta), and with
# viscosity on its history: law = growth p(theta) + history. The kernels compute factor law + rest;
# with rest = (1 - factor) pressure the fixed point is the law.

# Poisson's ratio above which the pressure is split, and that of the stiffness within a solve.
SPLIT_ABOVE, SPLIT_LIKE = 0.495, 0.47
# Settlings of one solve after which the fraction that follows the volume grows by the second.
SETTLINGS, STIFFER = 6, 4.0


def split_factor(poisson: float) -> float:
    """Return the fraction of the pressure that follows the volume within a solve; 1: all of it."""
    if poisson <= SPLIT_ABOVE:
        return 1.0
    return (1 - 2 * poisson) / (1 - 2 * SPLIT_LIKE)


@functools.cache
def _volume_kernels(real):
    modes_of = modes_function(real)
    _strain, _cofactor, _deformed, mean_change, pressure_of = kinematics(real)
    one = real(1.0)

    @kernel()
    def settle(
        mesh: mesh_struct(real),
        # `bulk_history` becomes that of the new pressure
        material: material_struct(real),
        factor: wp.array(dtype=real),
        history: wp.array2d(dtype=real),
        active: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vector_of(real)),
        # Out:
        pressure_out: wp.array2d(dtype=real),
    ):
        env, e = wp.tid()
        if active[env] == 0:
            return
        m = mesh.variant[env]
        if mesh.weight[m, e, 0] == real(0.0):  # outside a round body
            return
        moved = modes_of(mesh.elements, u, env, e)
        _volume, theta, _lowest = mean_change(mesh, m, e, moved)
        pressure = material.bulk_factor[env] * pressure_of(material.bulk[env], theta)
        pressure += material.bulk_history[env, e]
        pressure_out[env, e] = pressure
        material.bulk_history[env, e] = (
            factor[env] * history[env, e] + (one - factor[env]) * pressure
        )

    @kernel()
    def compose(
        # In:
        factor: wp.array(dtype=real),
        history: wp.array2d(dtype=real),
        pressure: wp.array2d(dtype=real),
        active: wp.array(dtype=wp.int32),
        # Out:
        lagged_out: wp.array2d(dtype=real),
    ):
        env, e = wp.tid()
        if active[env] == 1:
            rest = (one - factor[env]) * pressure[env, e]
            lagged_out[env, e] = factor[env] * history[env, e] + rest

    return settle, compose


class VolumePressure:
    """Pressure of elements at the last settled state; `history` (B, E) [E] stays in a step."""

    def __init__(
        self, real, poisson: NDArray[np.float64], elements: int, device: str, history=None
    ) -> None:
        self._least = np.array([split_factor(one) for one in poisson])
        self.fraction = self._least.copy()
        """Fraction of the pressure that follows the volume (B,)."""
        self._factor = wp.array(self.fraction.astype(numpy_of(real)), dtype=real, device=device)
        self.pressure = wp.zeros((len(poisson), elements), dtype=real, device=device)
        """Pressure at the last settled state (B, E) [E]."""
        self.lagged = wp.zeros_like(self.pressure)
        """Part of the pressure that does not follow the volume: an input of element kernels."""
        self._history = wp.zeros_like(self.pressure) if history is None else history
        self.pressure_old = wp.zeros_like(self.pressure)
        """The same at the last accepted step."""
        self._whole = wp.zeros_like(self.pressure)
        self._real, self._device = real, device
        self._settle, self._compose = _volume_kernels(real)

    def stiffen(self, chosen: NDArray[np.bool_], factor: float) -> None:
        """Multiply the fraction that follows by `factor`, up to 1; with 0 return to the least."""
        self.fraction[chosen] = np.clip(factor * self.fraction, self._least, 1.0)[chosen]
        self._factor.assign(self.fraction.astype(numpy_of(self._real)))

    def compose(self, active) -> None:
        """Update `lagged` where the pressure, the fraction or the history has changed."""
        inputs = [self._factor, self._history, self.pressure, active]
        self._launch(self._compose, inputs, self.lagged)

    def settle(self, mesh, material, active, u) -> None:
        """Set the pressure to that at `u`, and with it `lagged`, the history of the material."""
        inputs = [mesh, material, self._factor, self._history, active, u]
        self._launch(self._settle, inputs, self.pressure)

    def _launch(self, one, inputs, out) -> None:
        wp.launch(one, out.shape, inputs, [out], device=self._device)

    def accept(self, active) -> None:
        """Make the current pressure that of the last accepted step."""
        copy_active(active, self.pressure, self.pressure_old)

    def roll_back(self, active) -> None:
        """Return to the pressure of the last accepted step."""
        copy_active(active, self.pressure_old, self.pressure)

    def put_within(self, active, fraction: float) -> None:
        """Set the pressure a fraction of the way through the step: one half, then the whole."""
        if fraction < 1.0:
            copy_active(active, self.pressure, self._whole)
            mean = fraction * self.pressure.numpy() + (1 - fraction) * self.pressure_old.numpy()
            within = wp.array(mean.astype(numpy_of(self._real)), device=self._device)
            copy_active(active, within, self.pressure)
        else:
            copy_active(active, self._whole, self.pressure)
