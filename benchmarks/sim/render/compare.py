"""Similarity of two masks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]


def iou(one: Mask, other: Mask) -> float:
    """Return the intersection over union of the marker pixels; 1 if neither has any."""
    either = int((one | other).sum())
    return int((one & other).sum()) / either if either else 1.0


def mismatch(one: Mask, other: Mask) -> float:
    """Return the fraction of all pixels in which they differ."""
    return float((one != other).mean())
