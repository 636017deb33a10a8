"""R2 from sums over frames."""

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
