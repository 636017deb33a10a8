# mypy: ignore-errors
# Warp's vector types are made at run time; mypy cannot follow them.
"""The two precisions, with their vector and matrix types, and a determinant."""

import functools

import numpy as np
import warp as wp

# Warp's scalar type by the option value.
PRECISIONS = {"float32": wp.float32, "float64": wp.float64}


@functools.cache
def vector_of(real):
    """Return the 3-vector of a scalar type."""
    return wp.types.vector(length=3, dtype=real)


@functools.cache
def matrix_of(real):
    """Return the 3x3 matrix of a scalar type."""
    return wp.types.matrix(shape=(3, 3), dtype=real)


@functools.cache
def det_less_one_function(real):
    """Return `det_less_one(H)` for kernels: det(1 + H) - 1, of a displacement gradient H."""
    mat33 = matrix_of(real)

    @wp.func
    def det_less_one(h: mat33):
        """Return det(1 + h) - 1 without the cancellation that costs float32 half its digits."""
        minors = (
            h[0, 0] * h[1, 1]
            - h[0, 1] * h[1, 0]
            + h[1, 1] * h[2, 2]
            - h[1, 2] * h[2, 1]
            + h[0, 0] * h[2, 2]
            - h[0, 2] * h[2, 0]
        )
        return wp.trace(h) + minors + wp.determinant(h)

    return det_less_one


def numpy_of(real):
    """Return NumPy's scalar type for one of Warp's."""
    return np.float32 if real == wp.float32 else np.float64
