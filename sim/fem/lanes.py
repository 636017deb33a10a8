# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Forces and tangents of elements on a CPU: those of `sim.fem.element`, eight elements at once.

Compiled element by element, a CPU does one multiplication at a time. So both are written here in
C++ with Clang's vector types, which compile for every CPU: a `wide` holds one number of each of
eight elements (docs/decisions/0036).

Corners, Gauss points and modes have numbers of three bits, those of x, y and z; a mode is the
product of the reference coordinates whose bits are set. Sums with the signs of such products are
Walsh-Hadamard transforms, axis by axis.
"""

import functools
from string import Template

import warp as wp

from sim.device import kernel
from sim.fem.arrays import material_struct, mesh_struct
from sim.fem.element import SMALL, STIFF_FROM
from sim.scalars import matrix_of, vector_of

# Elements that a thread computes at once.
AT_ONCE = 8

# Integers as wide; 4/3 of the bits of 1, where Newton's method for x^(-1/3) begins, at most 6 %
# off, and its steps to full precision.
_ROOT = {
    wp.float32: {"integer": "int", "bits": "1420470954", "steps": "3"},
    wp.float64: {"integer": "long long", "bits": "6142909891733356544", "steps": "5"},
}

# Both kernels begin with: displacements of eight elements, their gradients h at the Gauss
# points, and volume changes.
_DEFORMED = """
    typedef $number number;
    typedef $integer integer;
    typedef number wide __attribute__((ext_vector_type(8)));
    typedef integer wide_integer __attribute__((ext_vector_type(8)));
    typedef number eight __attribute__((ext_vector_type(8), aligned(sizeof(number))));
    const number half = number(0.5), third = number(1.0 / 3.0);
    const wide tiny = number(1e-30);
    // A corner's value in each mode, but for its sign
    const number eighth = number(0.125), abscissa = number(0.5773502691896258);
    const number value[8] = {0, eighth, eighth, eighth * abscissa, eighth, eighth * abscissa,
                             eighth * abscissa, eighth * abscissa * abscissa};
    const int box[3] = {4, 2, 1};  // bits of x, y and z

    // Transform from corners or points to modes, or back; `skip`: the bit of an axis to leave.
    const auto transform = [](wide* values, int inner, int skip, bool back) {
        for (int bit = 4; bit; bit >>= 1)
            for (int low = 0; low < 8; ++low)
                if (bit != skip && !(low & (bit | skip))) {
                    wide *first = values + low * inner, *second = first + bit * inner;
                    for (int i = 0; i < inner; ++i) {
                        const wide one = first[i], other = second[i];
                        first[i] = back ? one - other : one + other;
                        second[i] = back ? one + other : other - one;
                    }
                }
    };
    const auto cofactor = [](const wide (&f)[3][3], wide (&c)[3][3]) {
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                const int k = (i + 1) % 3, l = (i + 2) % 3, m = (j + 1) % 3, n = (j + 2) % 3;
                c[i][j] = f[k][m] * f[l][n] - f[k][n] * f[l][m];
            }
    };
    const auto inverse_root = [](wide x) -> wide {  // x^(-1/3)
        wide y = __builtin_bit_cast(
            wide, integer($bits) - __builtin_bit_cast(wide_integer, x) / 3);
        for (int step = 0; step < $steps; ++step)
            y *= (4 - x * y * y * y) * number(1.0 / 3.0);
        return y;
    };

    // Lanes past the last element repeat it; elements outside a round body have no weight. Their
    // numbers are of no use, and not written.
    const int count = mesh.elements.shape[0], kind = mesh.variant.data[env];
    const int jacobians = mesh.inverse.shape[2];  // boxes have one for all Gauss points
    int element[8];
    bool used[8], any = false;
    number corners[8][3][8], inverses[8][3][3][8], weights[8][8];
    for (int lane = 0; lane < 8; ++lane) {
        const int e = wp::min(8 * group + lane, count - 1);
        element[lane] = e;
        for (int a = 0; a < 8; ++a) {
            const auto moved = wp::address(u, env, *wp::address(mesh.elements, e, a));
            for (int i = 0; i < 3; ++i)
                corners[a][i][lane] = (*moved)[i];
            weights[a][lane] = *wp::address(mesh.weight, kind, e, a);
        }
        for (int q = 0; q < jacobians; ++q)
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j)
                    inverses[q][i][j][lane] = wp::address(mesh.inverse, kind, e, q)->data[i][j];
        used[lane] = 8 * group + lane < count && weights[0][lane] != 0;
        any = any || used[lane];
    }
    if (!any)
        return;
    const number stiff = material.bulk.data[env];
    const auto inverse_of = [&](int q, int r, int j) -> wide {
        return *(const eight*)inverses[wp::min(q, jacobians - 1)][r][j];
    };

    wide mode[8][3];
    for (int a = 0; a < 8; ++a)
        for (int i = 0; i < 3; ++i)
            mode[a][i] = *(const eight*)corners[a][i];
    transform(mode[0], 3, 0, false);

    // Gradients along the reference directions r; they do not depend on the coordinate along r.
    wide along[3][8][3];
    for (int r = 0; r < 3; ++r) {
        for (int b = 0; b < 8; ++b)
            if (b & box[r])
                for (int i = 0; i < 3; ++i)
                    along[r][b ^ box[r]][i] = mode[b][i] * value[b];
        transform(along[r][0], 3, box[r], true);
    }

    wide h[8][3][3], less[8], w[8], volume = 0, change = 0, lowest = number(1e30);
    for (int q = 0; q < 8; ++q) {
        auto& d = h[q];
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                d[i][j] = 0;
                for (int r = 0; r < 3; ++r)
                    d[i][j] += along[r][q & ~box[r]][i] * inverse_of(q, r, j);
            }
        wide minor[3][3];
        cofactor(d, minor);
        // det(1 + h) - 1, without the cancellation that costs float32 half its digits
        less[q] = d[0][0] + d[1][1] + d[2][2] + (minor[0][0] + minor[1][1] + minor[2][2])
                + (d[0][0] * minor[0][0] + d[0][1] * minor[0][1] + d[0][2] * minor[0][2]);
        w[q] = *(const eight*)weights[q];
        volume += w[q];
        change += w[q] * less[q];
        lowest = __builtin_elementwise_min(lowest, 1 + less[q]);
    }
    const wide theta = change / volume;
    wide pressure = half * stiff * theta * (2 + theta) / (1 + theta);
    wide stiffness = half * stiff * (1 + 1 / ((1 + theta) * (1 + theta)));
$pressure"""

# Both do first at a Gauss point: F, its cofactor, |F|^2, J and g = G J^(-2/3).
_POINT = """
        wide f[3][3], c[3][3], square = 0;
        for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k) {
                f[i][k] = h[q][i][k] + number(i == k);
                square += f[i][k] * f[i][k];
            }
        cofactor(f, c);
        const wide j = 1 + less[q], root = inverse_root(__builtin_elementwise_max(j, tiny));
        wide g = material.shear.data[env] * root * root;
$stiffer"""

# Stiffening of skin that is strained far, of `sim.fem.element`: I beyond its beginning.
_STIFFER = """
        const wide beyond = __builtin_elementwise_max(root * root * square - number($from), tiny);
        g *= 1 + material.stiffening.data[env] * beyond;
"""

# Energy of the stiffening, and its part of the tangent by the derivatives of I.
_STIFFER_ENERGY = """
        energy += w[q] * half * half * material.shear.data[env]
                * material.stiffening.data[env] * beyond * beyond;
"""
_STIFFER_BLOCK = """
                for (int i = 0; i < 3; ++i)
                    for (int k = 0; k < 3; ++k)
                        block[i][k] += dr[r][i] * dr[s][k] * bend;
"""
_STIFFER_SLOPES = """
        wide dr[3][3], bend = w[q] * half * material.shear.data[env];
        bend *= material.stiffening.data[env];
        bend *= $growth __builtin_elementwise_min(beyond * number(1e20), number(1) + 0 * g);
        for (int r = 0; r < 3; ++r)
            for (int i = 0; i < 3; ++i) {
                wide fr = 0;
                for (int k = 0; k < 3; ++k)
                    fr += f[i][k] * inv[r][k];
                dr[r][i] = 2 * root * root * (fr - cr[r][i] * square * third / j);
            }
"""

# Pressure with a history, of viscous and of split bodies.
_PRESSURE = """
    wide held;
    for (int lane = 0; lane < 8; ++lane)
        held[lane] = *wp::address(material.bulk_history, env, element[lane]);
    pressure = material.bulk_factor.data[env] * pressure + held;
    stiffness *= material.bulk_factor.data[env];
"""

# Stress history of a Gauss point.
_PAST = """
        wide past[3][3];
        for (int lane = 0; lane < 8; ++lane)
            for (int i = 0; i < 3; ++i)
                for (int k = 0; k < 3; ++k) {
                    const auto stress = wp::address(material.history, env, element[lane], q);
                    past[i][k][lane] = stress->data[i][k];
                }
"""

_FORCES = """
    // Energies of volume and shape as `energy_functions` of `sim.fem.element` have them
    const auto small = [](wide x) { return x * x < number($small * $small); };
    const wide stretched = __builtin_elementwise_log(__builtin_elementwise_max(1 + theta, tiny));
    const wide series = theta * theta * (1 - theta * (third - theta * (half * half - theta / 5)));
    wide energy = volume * half * stiff
                * (small(theta) ? series : half * theta * (2 + theta) - stretched);
    wide back[3][8][3] = {};
    for (int q = 0; q < 8; ++q) {
$point
        const auto& d = h[q];
        wide minor[3][3], stress[3][3], squared = 0;
        for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k)
                squared += d[i][k] * d[i][k];
        cofactor(d, minor);
        // F - cof(F) tr(F^T F) / 3J in terms of h = F - 1: no cancellation at small strain
        const wide trace = d[0][0] + d[1][1] + d[2][2];
        const wide excess = (2 * trace + squared - 3 * less[q]) * (third / j);
        const wide x = less[q], power = root * root;
        const wide changed = x * x * (third - x * (10 - x * (10 - x * 88 / 9)) / 27);
        energy += w[q] * half * material.shear.data[env]
                * (power * (squared + 2 * (trace - x))
                   + (small(x) ? changed : power * (3 + 2 * x) - 3));
        for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k)
                stress[i][k] = (d[i][k] + d[k][i] - minor[i][k] - c[i][k] * excess) * g;
        for (int i = 0; i < 3; ++i)
            stress[i][i] -= trace * g;
$energy$stress
        for (int i = 0; i < 3; ++i) {
            for (int k = 0; k < 3; ++k)
                stress[i][k] = (stress[i][k] + c[i][k] * pressure) * w[q];
            for (int r = 0; r < 3; ++r)
                for (int k = 0; k < 3; ++k)
                    back[r][q & ~box[r]][i] += stress[i][k] * inverse_of(q, r, k);
        }
    }

    wide force[8][3] = {};
    for (int r = 0; r < 3; ++r) {
        transform(back[r][0], 3, box[r], false);
        for (int b = 0; b < 8; ++b)
            if (b & box[r])
                for (int i = 0; i < 3; ++i)
                    force[b][i] += back[r][b ^ box[r]][i] * value[b];
    }
    transform(force[0], 3, 0, true);

    for (int lane = 0; lane < 8; ++lane) {
        if (!used[lane])
            continue;
        const int e = element[lane];
        for (int a = 0; a < 8; ++a)
            for (int i = 0; i < 3; ++i)
                (*wp::address(force_out, env, e, a))[i] = force[a][i][lane];
        *wp::address(energy_out, env, e) = energy[lane];
        *wp::address(det_out, env, e) = lowest[lane];
    }
"""

_VISCOUS_STRESS = """
        for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k) {
                stress[i][k] *= material.factor.data[env];
                for (int l = 0; l < 3; ++l)
                    stress[i][k] += f[i][l] * past[l][k];
            }
"""

# The tangent: first the blocks of `sim.fem.element` between reference directions r and s at the
# Gauss points. The derivative of mode b along r is mode b without the bit of r, so a block between
# modes is a sum of Walsh-Hadamard coefficients of those over the points, and a second transform
# leads from modes to corners: about 10,000 operations an element, where 8 corners times 8 points
# would take 40,000.
_TANGENT = """
    stiffness /= volume;
    // Blocks (r, s) in the order 00 11 22 01 02 12, and gradients of the volume
    wide moments[8][7][3][3];
    const int order[3][3] = {{0, 3, 4}, {3, 1, 5}, {4, 5, 2}};
    for (int q = 0; q < 8; ++q) {
$point
        wide inv[3][3], crossed[3][3];
        for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k)
                inv[i][k] = inverse_of(q, i, k);
        cofactor(inv, crossed);
$factor
        const wide over = g * third / j;
        const wide mixed = w[q] * over * number(5.0 / 3.0) * square / j;
        wide turning = pressure - over * square;
        if (convex.data[env]) {
            // The square of the largest stretch is at most that of matrices with this trace and
            // norm (Wolkowicz & Styan 1980).
            wide norm = 0;
            for (int i = 0; i < 3; ++i)
                for (int k = 0; k < 3; ++k) {
                    const wide s = f[0][i] * f[0][k] + f[1][i] * f[1][k] + f[2][i] * f[2][k];
                    norm += s * s;
                }
            const wide average = square * third, none = 0;
            const wide spread = __builtin_elementwise_max(norm * third - average * average, none);
            const wide most = g / __builtin_elementwise_sqrt(
                average + __builtin_elementwise_sqrt(2 * spread));
            turning = __builtin_elementwise_max(__builtin_elementwise_min(turning, most), -most);
        }
        // Columns of F (G_1 x G_2), F (G_2 x G_0), F (G_0 x G_1); half of the c c^T term on either
        // side makes it a product with its transpose.
        wide cr[3][3], er[3][3], turn[3][3];
        for (int r = 0; r < 3; ++r)
            for (int i = 0; i < 3; ++i) {
                wide fr = 0, tr = 0;
                cr[r][i] = 0;
                for (int k = 0; k < 3; ++k) {
                    cr[r][i] += c[i][k] * inv[r][k];
                    fr += f[i][k] * inv[r][k];
                    tr += f[i][k] * crossed[r][k];
                }
                er[r][i] = cr[r][i] * (mixed * half) - fr * (w[q] * 2 * over);
                turn[r][i] = tr * (w[q] * turning);
                moments[q][6][r][i] = cr[r][i] * w[q];
            }
$slopes        for (int r = 0; r < 3; ++r)
            for (int s = r; s < 3; ++s) {
                auto& block = moments[q][order[r][s]];
                wide metric = inv[r][0] * inv[s][0] + inv[r][1] * inv[s][1] + inv[r][2] * inv[s][2];
                metric *= w[q] * g;
$metric
                for (int i = 0; i < 3; ++i)
                    for (int k = 0; k < 3; ++k)
                        block[i][k] = er[r][i] * cr[s][k] + cr[r][i] * er[s][k];
$block                for (int i = 0; i < 3; ++i)
                    block[i][i] += metric;
                if (r == s)
                    continue;
                // The cross product with the column that belongs to both, (r, s) = (0, 2) reversed
                const auto& v = turn[3 - r - s];
                const number sign = s - r == 2 ? 1 : -1;
                for (int i = 0; i < 3; ++i) {
                    const int k = (i + 1) % 3, l = (i + 2) % 3;
                    block[k][l] -= sign * v[i];
                    block[l][k] += sign * v[i];
                }
            }
    }
    transform(&moments[0][0][0][0], 63, 0, false);

    wide mean[8][3] = {};  // gradients of the volume, by mode
    for (int a = 1; a < 8; ++a)
        for (int r = 0; r < 3; ++r)
            if (a & box[r])
                for (int i = 0; i < 3; ++i)
                    mean[a][i] += moments[a ^ box[r]][6][r][i];
    wide blocks[8][8][3][3] = {};
    for (int a = 1; a < 8; ++a)
        for (int b = a; b < 8; ++b) {
            wide block[3][3] = {};
            for (int r = 0; r < 3; ++r)
                for (int s = 0; s < 3; ++s)
                    if ((a & box[r]) && (b & box[s])) {
                        const auto& of = moments[a ^ box[r] ^ b ^ box[s]][order[r][s]];
                        for (int i = 0; i < 3; ++i)
                            for (int k = 0; k < 3; ++k)
                                block[i][k] += r <= s ? of[i][k] : of[k][i];
                    }
            const number both = value[a] * value[b];
            for (int i = 0; i < 3; ++i)
                for (int k = 0; k < 3; ++k) {
                    const wide sum = block[i][k] + mean[a][i] * stiffness * mean[b][k];
                    blocks[a][b][i][k] = blocks[b][a][k][i] = sum * both;
                }
        }
    transform(&blocks[0][0][0][0], 72, 0, true);
    for (int a = 0; a < 8; ++a)
        transform(&blocks[a][0][0][0], 9, 0, true);

    // Eight numbers of each lane, instead of each number of eight lanes
    number apart[8][576];
    const wide* from = &blocks[0][0][0][0];
    for (int k = 0; k < 576; k += 8) {
        wide x[8], y[8];
        for (int i = 0; i < 4; ++i) {
            const wide one = from[k + i], other = from[k + i + 4];
            x[i] = __builtin_shufflevector(one, other, 0, 1, 2, 3, 8, 9, 10, 11);
            x[i + 4] = __builtin_shufflevector(one, other, 4, 5, 6, 7, 12, 13, 14, 15);
        }
        for (int i = 0; i < 8; ++i)
            if (!(i & 2)) {
                y[i] = __builtin_shufflevector(x[i], x[i + 2], 0, 1, 8, 9, 4, 5, 12, 13);
                y[i + 2] = __builtin_shufflevector(x[i], x[i + 2], 2, 3, 10, 11, 6, 7, 14, 15);
            }
        for (int i = 0; i < 8; i += 2) {
            *(eight*)&apart[i][k] =
                __builtin_shufflevector(y[i], y[i + 1], 0, 8, 2, 10, 4, 12, 6, 14);
            *(eight*)&apart[i + 1][k] =
                __builtin_shufflevector(y[i], y[i + 1], 1, 9, 3, 11, 5, 13, 7, 15);
        }
    }
    const auto offset = [](int corner) {  // in the stencil's 27 slots
        return 9 * (corner >> 2) + 3 * ((corner >> 1) & 1) + (corner & 1);
    };
    for (int lane = 0; lane < 8; ++lane) {
        if (!used[lane])
            continue;
        const int* nodes = wp::address(mesh.elements, element[lane], 0);
        for (int a = 0; a < 8; ++a) {
            if (!mesh.free.data[nodes[a]])
                continue;
            number* row = (number*)wp::address(matrix_out, env, nodes[a], 13 - offset(a));
            for (int b = 0; b < 8; ++b)
                if (mesh.free.data[nodes[b]]) {
                    const number* block = &apart[lane][(8 * a + b) * 9];
                    number* sum = row + 9 * offset(b);
                    *(eight*)sum += *(const eight*)block;
                    sum[8] += block[8];
                }
        }
    }
"""

_VISCOUS_METRIC = """
                for (int k = 0; k < 3; ++k)
                    for (int l = 0; l < 3; ++l)
                        metric += inv[r][k] * past[k][l] * inv[s][l] * w[q];
"""


def native_of(real):
    """Return the name in C++ of one of Warp's scalar types."""
    return "float" if real == wp.float32 else "double"


def _point(stiffening: bool) -> str:
    stiffer = Template(_STIFFER).safe_substitute({"from": STIFF_FROM}) if stiffening else ""
    return Template(_POINT).safe_substitute(stiffer=stiffer)


@functools.cache
def forces_kernel(real, viscous: bool, split: bool = False, stiffening: bool = False):
    """Return the kernel of forces, `AT_ONCE` elements a thread; launched over (B, groups)."""
    vec3 = vector_of(real)
    parts = {"pressure": "", "stress": "", "energy": "", "small": SMALL[real]}
    parts["point"] = _point(stiffening)
    if wp.static(viscous or split):
        parts["pressure"] = _PRESSURE
    if wp.static(viscous):
        parts["stress"] = _PAST + _VISCOUS_STRESS
    if stiffening:
        parts["energy"] = _STIFFER_ENERGY

    @wp.func_native(
        Template(_DEFORMED + _FORCES).substitute(parts, number=native_of(real), **_ROOT[real])
    )
    def forces(
        mesh: mesh_struct(real),
        material: material_struct(real),
        u: wp.array2d(dtype=vec3),
        env: int,
        group: int,
        force_out: wp.array3d(dtype=vec3),
        energy_out: wp.array2d(dtype=real),
        det_out: wp.array2d(dtype=real),
    ): ...

    @kernel()
    def residual(
        mesh: mesh_struct(real),
        material: material_struct(real),
        active: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
        force_out: wp.array3d(dtype=vec3),
        energy_out: wp.array2d(dtype=real),
        det_out: wp.array2d(dtype=real),
    ):
        env, group = wp.tid()
        if active[env] == 1:
            forces(mesh, material, u, env, group, force_out, energy_out, det_out)

    return residual


@functools.cache
def blocks_kernel(real, viscous: bool, split: bool = False, stiffening: bool = False):
    """Return the kernel that adds the tangents of `AT_ONCE` elements a thread to the stencils.

    Threads must run one after the other, as on a CPU: elements share nodes. The 27 blocks of a row
    must be contiguous. The dimensions of a launch are the environments and the groups of elements.
    """
    vec3 = vector_of(real)
    mat33 = matrix_of(real)
    parts = dict.fromkeys(("pressure", "factor", "metric", "slopes", "block"), "")
    parts["point"] = _point(stiffening)
    if wp.static(viscous or split):
        parts["pressure"] = _PRESSURE
    if wp.static(viscous):
        parts["factor"] = _PAST + "        g *= material.factor.data[env];\n"
        parts["metric"] = _VISCOUS_METRIC
    if stiffening:
        growth = "material.factor.data[env] *" if viscous else ""
        parts["slopes"] = Template(_STIFFER_SLOPES).safe_substitute(growth=growth)
        parts["block"] = _STIFFER_BLOCK

    @wp.func_native(
        Template(_DEFORMED + _TANGENT).substitute(parts, number=native_of(real), **_ROOT[real])
    )
    def tangents(
        mesh: mesh_struct(real),
        material: material_struct(real),
        u: wp.array2d(dtype=vec3),
        convex: wp.array(dtype=wp.int32),
        env: int,
        group: int,
        matrix_out: wp.array3d(dtype=mat33),
    ): ...

    @kernel()
    def element_blocks(
        mesh: mesh_struct(real),
        material: material_struct(real),
        active: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
        convex: wp.array(dtype=wp.int32),
        matrix_out: wp.array3d(dtype=mat33),
    ):
        env, group = wp.tid()
        if active[env] == 1:
            tangents(mesh, material, u, convex, env, group, matrix_out)

    return element_blocks
