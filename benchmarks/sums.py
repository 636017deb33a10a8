"""Scores of forces from sums over frames, which may be added up by indenter before."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def r_squared_of_sums(count: Floats, one: Floats, square: Floats, missed: Floats) -> Floats:
    """Return R2 from sums over frames, which may be added up before; arrays of any shape.

    Args:
        count: Number of frames.
        one: Sum of the true values.
        square: Sum of their squares.
        missed: Sum of squared errors.

    Returns:
        NaN where true values do not vary, to 1e-9 in the sum of their squared deviations.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        varied = square - one**2 / count
        return np.asarray(1 - missed / np.where(varied > 1e-9, varied, np.nan))


def sums_by_indenter(
    true: Floats, predicted: Floats, indenter: NDArray[np.str_]
) -> dict[str, Floats]:
    """Return sums (5, 3) of each indenter's frames.

    Count, forces, their squares, squared and absolute errors.

    Args:
        true: Forces (n, 3) [N].
        predicted: Predicted forces (n, 3) [N].
        indenter: Name of each frame's indenter (n,).
    """
    error = predicted - true
    parts = np.stack([np.ones_like(true), true, true**2, error**2, np.abs(error)], axis=1)
    return {str(name): parts[indenter == name].sum(axis=0) for name in np.unique(indenter)}


def r2_of(sums: Floats) -> Floats:
    """Return R2 (...), mean of axes, from sums (..., 5, 3); NaN where forces do not vary."""
    parts = np.moveaxis(sums[..., :4, :], -2, 0)
    return np.asarray(r_squared_of_sums(*parts).mean(axis=-1))
