"""How far two masks cover each other: Dice, intersection over union, area. Of numpy or of torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError

if TYPE_CHECKING:
    import torch

    Masks = NDArray[np.bool_] | torch.Tensor

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Overlap:
    """Pixels of pairs of masks."""

    common: NDArray[np.int64]
    """Set in both (n,)."""
    found: NDArray[np.int64]
    """Set in what is judged (n,)."""
    true: NDArray[np.int64]
    """Set in what it should be (n,)."""

    @property
    def dice(self) -> Floats:
        """Twice the common pixels over the sum of both (n,); 1 where both are empty."""
        return _share(2 * self.common, self.found + self.true)

    @property
    def iou(self) -> Floats:
        """Common pixels over those that are set in either (n,); 1 where both are empty."""
        return _share(self.common, self.found + self.true - self.common)

    @property
    def area_ratio_error(self) -> Floats:
        """|found / true - 1| (n,); NaN where nothing should be set."""
        empty = self.true == 0
        ratio = self.found / np.where(empty, 1, self.true)
        return np.where(empty, np.nan, np.abs(ratio - 1))


def overlap(found: Masks, true: Masks) -> Overlap:
    """Return how many pixels masks (n, h, w) have in common, both of numpy or both of torch.

    Raises:
        LearningError: Other shapes, or not bool.
    """
    if tuple(found.shape) != tuple(true.shape) or found.ndim != 3:
        raise LearningError(
            f"masks: found {tuple(found.shape)} and {tuple(true.shape)}; allowed: both (n, h, w)"
        )
    for masks in (found, true):
        if str(masks.dtype) not in ("bool", "torch.bool"):
            raise LearningError(f"masks: found {masks.dtype}; allowed: bool")
    one: Any = found
    return Overlap(_pixels(one & true), _pixels(found), _pixels(true))


def _pixels(masks: Any) -> NDArray[np.int64]:
    """Return the number of set pixels (n,); counted where the masks are."""
    counted = masks.reshape(len(masks), masks.shape[1] * masks.shape[2]).sum(1)
    return np.asarray(counted if isinstance(masks, np.ndarray) else counted.cpu(), np.int64)


def _share(part: NDArray[np.int64], whole: NDArray[np.int64]) -> Floats:
    return np.where(whole == 0, 1.0, part / np.where(whole == 0, 1, whole))
