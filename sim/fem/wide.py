# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""A row of the stencil in a CPU's wide registers: times a vector, and rounded.

A row is 27 blocks of 3x3 in a piece, 243 numbers. Compiled block by block, a product takes twice as
long (docs/results/speed.md), and float16 is converted bit by bit. So rows are written here as the
lanes of eight that Clang offers for every CPU. Three neighbours in a line are next to each other in
memory: nine times three blocks make a row.
"""

import functools

import warp as wp

from sim.fem.scalars import matrix_of, vector_of

_NATIVE = {wp.float16: "_Float16", wp.float32: "float", wp.float64: "double"}

_TYPES = """
    typedef {real} number;
    typedef {stored} kept;
    typedef number wide __attribute__((ext_vector_type(8)));
    typedef number four __attribute__((ext_vector_type(4), aligned(sizeof(number))));
    typedef kept eight __attribute__((ext_vector_type(8), aligned(sizeof(kept))));
"""

_LINE = (
    _TYPES
    + """
    const kept* m = (const kept*)((const char*)matrix.data + env * (size_t)matrix.strides[0]
                                  + n * (size_t)matrix.strides[1]);
    const number* x = (const number*)((const char*)v.data + env * (size_t)v.strides[0]);
    const int last = v.shape[1] - 1;
    wide sum0 = 0, sum1 = 0, sum2 = 0;
    number ninth = 0;
    for (int near = 0; near < 9; ++near, m += 27) {{
        const int first = n + offsets.data[3 * near];
        number clamped[9];
        const number* y = x + 3 * first;
        if (first < 0 || first + 2 > last) {{
            for (int i = 0; i < 9; ++i)
                clamped[i] = x[3 * wp::clamp(first + i / 3, 0, last) + i % 3];
            y = clamped;
        }}
        const four a = *(const four*)y, b = *(const four*)(y + 3), c = *(const four*)(y + 5);
        sum0 += __builtin_convertvector(*(const eight*)m, wide)
              * __builtin_shufflevector(a, a, 0, 1, 2, 0, 1, 2, 0, 1);
        sum1 += __builtin_convertvector(*(const eight*)(m + 9), wide)
              * __builtin_shufflevector(b, b, 0, 1, 2, 0, 1, 2, 0, 1);
        sum2 += __builtin_convertvector(*(const eight*)(m + 18), wide)
              * __builtin_shufflevector(c, c, 1, 2, 3, 1, 2, 3, 1, 2);
        ninth += (number)m[8] * y[2] + (number)m[17] * y[5] + (number)m[26] * y[8];
    }}
    const wide sum = sum0 + sum1 + sum2;
    return wp::vec_t<3, number>(sum[0] + sum[1] + sum[2], sum[3] + sum[4] + sum[5],
                                sum[6] + sum[7] + ninth);
"""
)

_ROUND = (
    _TYPES
    + """
    const number* m = (const number*)((const char*)matrix.data + env * (size_t)matrix.strides[0]
                                      + n * (size_t)matrix.strides[1]);
    kept* out = (kept*)((char*)kept_out.data + env * (size_t)kept_out.strides[0]
                        + n * (size_t)kept_out.strides[1]);
    for (int i = 0; i < 243; ++i)
        out[i] = (kept)m[i];
"""
)


@functools.cache
def wide_row(real, stored):
    """Functions for one precision; `stored` is the scalar type of the matrix that products read.

    Returns:
        `line(offsets, matrix, v, env, n)`: row n of a matrix (B, N, 27) times v (B, N), as the slow
        one of `stencil`; and `round_row(matrix, env, n, kept_out)`, which copies one. The 27 blocks
        of a row must be next to each other.
    """
    vec3, kept33 = vector_of(real), matrix_of(stored)
    types = {"real": _NATIVE[real], "stored": _NATIVE[stored]}

    @wp.func_native(_LINE.format(**types))
    def line(
        offsets: wp.array(dtype=wp.int32),
        matrix: wp.array3d(dtype=kept33),
        v: wp.array2d(dtype=vec3),
        env: int,
        n: int,
    ) -> vec3: ...

    @wp.func_native(_ROUND.format(**types))
    def round_row(
        matrix: wp.array3d(dtype=matrix_of(real)),
        env: int,
        n: int,
        kept_out: wp.array3d(dtype=kept33),
    ): ...

    return line, round_row
