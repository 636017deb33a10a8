# mypy: ignore-errors
# Warp reads the annotations of its functions as values, which no type checker follows.
"""The quadratic B-spline that ties a particle to 27 grid nodes, and the integers nodes sum up in.

Weights and their affine moment: Jiang et al., The affine particle-in-cell method (2015), section 5;
for this spline the moment of inertia is a quarter of a cell squared along each axis.
"""

import functools

import warp as wp

from sim.fem.scalars import matrix_of, vector_of

FIXED_POINT = 2.0**52
"""Units of the integers in which nodes sum up mass and momentum.

Integers add to the same bits in any order, so that a run repeats on every device. One unit is
2e-16, the range is +-2,048; in units of cells and time steps a node's mass is about 1 and speeds
are below 0.5. Larger units would let a slow body lose speed: the conversion cuts towards 0."""
MOMENT = 4.0
"""One over the spline's moment of inertia [1/cell^2]."""


@functools.cache
def spline_functions(real):
    """`first_node(x)` and the way from it; of that way, `weights` and `arms`, ways to all nodes.

    Of the matrices, rows are axes and columns the three nodes along each.
    """
    vec3, mat33 = vector_of(real), matrix_of(real)
    half, one, two = real(0.5), real(1.0), real(2.0)

    @wp.func
    def first_node(x: vec3):
        low = vec3(wp.floor(x[0] - half), wp.floor(x[1] - half), wp.floor(x[2] - half))
        return wp.vec3i(int(low[0]), int(low[1]), int(low[2])), x - low

    @wp.func
    def weights(from_first: vec3):
        found = mat33()
        for axis in range(3):
            f = from_first[axis]
            below = real(1.5) - f
            above = f - half
            found[axis, 0] = half * below * below
            found[axis, 1] = real(0.75) - (f - one) * (f - one)
            found[axis, 2] = half * above * above
        return found

    @wp.func
    def arms(from_first: vec3):
        found = mat33()
        for axis in range(3):
            found[axis, 0] = -from_first[axis]
            found[axis, 1] = one - from_first[axis]
            found[axis, 2] = two - from_first[axis]
        return found

    return first_node, weights, arms
