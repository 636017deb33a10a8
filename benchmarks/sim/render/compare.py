"""How alike two masks are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]


def iou(one: Mask, other: Mask) -> float:
    """Pixels that are marker in both over those that are in either; 1 where neither has any."""
    either = int((one | other).sum())
    return int((one & other).sum()) / either if either else 1.0


def mismatch(one: Mask, other: Mask) -> float:
    """Share of all pixels in which they differ."""
    return float((one != other).mean())
