"""Where markers are, to a small part of a pixel: centroids weighted by how dark each pixel is.

The centre of a binary patch moves in steps as pixels of its rim come and go; the greys of the rim
say how much of each pixel the marker covers.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from recorder.markers import SMALLEST_PX

_RIM_PX, _RING_PX = 2, 2
"""A marker's greys are looked at so far beyond its patch; its ground is the ring so wide around."""
_NONE = np.iinfo(np.uint16).max
"""No label: a picture has fewer markers."""


@dataclass(frozen=True, slots=True, eq=False)
class Centres:
    """Markers of one picture, from top to bottom."""

    place: NDArray[np.float64]
    """Column and row (n, 2) [px]; whole numbers are pixel centres."""
    area: NDArray[np.int64]
    """Pixels of the patch (n,)."""
    whole: NDArray[np.bool_]
    """Whether the image's border cuts nothing off (n,); the centre of a cut one is beside it."""

    def __len__(self) -> int:
        """Return the number of markers."""
        return len(self.area)


def find_centres(
    mask: NDArray[np.bool_], grey: NDArray[np.uint8] | None = None, smallest_px: int = SMALLEST_PX
) -> Centres:
    """Return the markers of a mask, placed by the greys of the picture if it is given.

    Args:
        mask: Markers (h, w).
        grey: The picture they were found in (h, w); None places them by the mask alone.
        smallest_px: Patches of fewer pixels are specks.

    Raises:
        LearningError: No mask, or a picture of another size.
    """
    if mask.dtype != np.bool_ or mask.ndim != 2:
        raise LearningError(f"mask: found {mask.dtype} {mask.shape}; allowed: bool (h, w)")
    if grey is not None and (grey.dtype != np.uint8 or grey.shape != mask.shape):
        raise LearningError(f"grey: found {grey.dtype} {grey.shape}; allowed: uint8 {mask.shape}")
    _, labels, stats, middle = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=4)
    area = stats[:, cv2.CC_STAT_AREA].astype(np.int64)
    left, top = stats[:, cv2.CC_STAT_LEFT], stats[:, cv2.CC_STAT_TOP]
    right, bottom = left + stats[:, cv2.CC_STAT_WIDTH], top + stats[:, cv2.CC_STAT_HEIGHT]
    whole = (left > 0) & (top > 0) & (right < mask.shape[1]) & (bottom < mask.shape[0])
    kept = area >= smallest_px
    kept[0] = False
    place = np.asarray(middle, np.float64)
    if grey is not None:
        place = _weighted(np.asarray(labels, np.int32), place, grey)
    return Centres(place[kept], area[kept], whole[kept])


def _weighted(
    labels: NDArray[np.int32], middle: NDArray[np.float64], grey: NDArray[np.uint8]
) -> NDArray[np.float64]:
    """Return centres (n, 2) weighted by the difference to the ground around each marker."""
    count = len(middle)
    near = _grown(labels, _RIM_PX)
    around = _grown(labels, _RIM_PX + _RING_PX)
    inner, ring = labels > 0, (around > 0) & (near == 0)
    values = grey.astype(np.float64)
    ground = _mean(around[ring], values[ring], count)
    ink = _mean(labels[inner], values[inner], count)
    row, column = np.nonzero(near)
    of = near[row, column]
    # A marker without a ring, one in a crowd, keeps the centre of its patch.
    known = np.isfinite(ground) & np.isfinite(ink) & (np.abs(ground - ink) >= 1.0)
    depth = np.where(known, ink - ground, 1.0)
    share = np.clip((values[row, column] - np.nan_to_num(ground)[of]) / depth[of], 0.0, 1.0)
    total = np.bincount(of, share, count)
    known &= total > 0
    safe = np.where(known, total, 1.0)
    weighted = np.stack(
        [np.bincount(of, share * along, count) / safe for along in (column, row)], axis=1
    )
    return np.where(known[:, None], weighted, middle)


def _grown(labels: NDArray[np.int32], by_px: int) -> NDArray[np.int64]:
    """Return labels (h, w) that reach so far beyond their patches; where two meet, neither is."""
    side = 2 * by_px + 1
    element = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    plain = labels.astype(np.uint16)
    most = cv2.dilate(plain, element)
    # Without the background, the least label that is near is found as the greatest is.
    plain[labels == 0] = _NONE
    least = cv2.erode(plain, element)
    grown = np.where(most == least, most, 0)
    return np.where(labels > 0, labels, grown).astype(np.int64)


def _mean(of: NDArray[np.integer], values: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    number = np.bincount(of, minlength=count)
    total = np.bincount(of, values, count)
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)
