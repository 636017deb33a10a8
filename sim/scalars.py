# mypy: ignore-errors
# Warp's vector types are made at run time; mypy cannot follow them.
"""The two precisions, with their vector and matrix types."""

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


def numpy_of(real):
    """Return NumPy's scalar type for one of Warp's."""
    return np.float32 if real == wp.float32 else np.float64
