# mypy: ignore-errors
# Warp reads the annotations of its functions as values, which no type checker follows.
"""The neo-Hookean law of `Body`, from the displacement gradient H = F - I.

Written in H, nothing that is 1 at rest is ever rounded: a body at rest has no stress, exactly, and
float32 keeps its digits at small strain.
"""

import functools

import warp as wp

from sim.fem.scalars import matrix_of


@functools.cache
def law_functions(real):
    """`dilatation(H)` = det(F) - 1, `kirchhoff(H, G, K)` and `energy(H, G, K)` per rest volume."""
    mat33 = matrix_of(real)
    one, half, third = real(1.0), real(0.5), real(1.0 / 3.0)
    # Quotients inside a kernel are taken in float32.
    power = real(-2.0 / 3.0)

    @wp.func
    def dilatation(h: mat33):
        minors = (
            h[0, 0] * h[1, 1]
            - h[0, 1] * h[1, 0]
            + h[1, 1] * h[2, 2]
            - h[1, 2] * h[2, 1]
            + h[0, 0] * h[2, 2]
            - h[0, 2] * h[2, 0]
        )
        return wp.trace(h) + minors + wp.determinant(h)

    @wp.func
    def kirchhoff(h: mat33, shear: real, bulk: real):
        grown = dilatation(h)
        strain = h + wp.transpose(h) + h * wp.transpose(h)
        isochoric = shear * wp.pow(one + grown, power)
        pressure = half * bulk * grown * (real(2.0) + grown)
        identity = wp.identity(n=3, dtype=real)
        return strain * isochoric + identity * (pressure - isochoric * third * wp.trace(strain))

    @wp.func
    def energy(h: mat33, shear: real, bulk: real):
        grown = dilatation(h)
        strain = h + wp.transpose(h) + h * wp.transpose(h)
        size = one + grown
        # J^(-2/3) (tr b - 3) + 3 (J^(-2/3) - 1), the second from ln J so that it keeps its digits.
        log = wp.log(size)
        shrunk = wp.exp(log * power)
        isochoric = wp.trace(strain) * shrunk + real(3.0) * (shrunk - one)
        volumetric = half * grown * (real(2.0) + grown) - log
        return half * (shear * isochoric + bulk * volumetric)

    return dilatation, kirchhoff, energy
