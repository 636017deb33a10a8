"""The edges of a mask's markers, to a part of a pixel: what a warp moves in place of the mask.

A mask says of every pixel yes or no, so that its edges are off by up to half a pixel, back and
forth along them. Markers are smooth: each is blurred on its own, and then taken where its level
keeps the area that it had. The mask is where the level is above one half.
"""

from __future__ import annotations

import functools

import cv2
import numpy as np
from numpy.typing import NDArray

from recorder.markers import pack, unpack

BLUR_PX = 1.0
"""Deviation of the blur. Wider, edges are smoother, and corners of squares and diamonds rounder."""
_REACH = 5  # pixels around a marker that its blur reaches
_LEAST_SLOPE = 1e-3  # of a level, a pixel: without an edge a pixel is above or below
_HALVINGS = 14
_REFERENCES = 64  # levels that are kept: a sensor that drifts has one reference a contact point


def edge_level(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return the level (480, 640), about 0 to 1, which is above 0.5 on markers; computed once."""
    return _level(pack(mask).tobytes())


@functools.lru_cache(maxsize=_REFERENCES)
def _level(packed: bytes) -> NDArray[np.float32]:
    mask = unpack(np.frombuffer(packed, np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=4)
    # Between markers a pixel belongs to the nearest.
    _, nearest = cv2.distanceTransformWithLabels(
        (~mask).view(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    owner = np.zeros(int(nearest.max()) + 1, np.int32)
    owner[nearest[mask]] = labels[mask]
    owners = owner[nearest]
    level = np.zeros(mask.shape, np.float32)
    for label in range(1, count):
        left, top, width, height, area = stats[label]
        part = (
            slice(max(top - _REACH, 0), top + height + _REACH),
            slice(max(left - _REACH, 0), left + width + _REACH),
        )
        # At the border a marker goes on: what is cut off there is not an edge.
        soft = cv2.GaussianBlur(
            (labels[part] == label).astype(np.float32),
            (0, 0),
            BLUR_PX,
            borderType=cv2.BORDER_REPLICATE,
        )
        middle = _middle(soft, float(area))
        mine = owners[part] == label
        level[part][mine] = soft[mine] + np.float32(0.5 - middle)
    level.flags.writeable = False
    return level


def _middle(soft: NDArray[np.float32], area: float) -> float:
    """Return the level of a blurred marker (h, w) above which so many pixels lie, parts counted.

    The share of a pixel that lies above follows from its level and the slope there: whole pixels
    would come and go by the dozen, since markers are symmetric.
    """
    down, across = np.gradient(soft)
    slope = np.maximum(np.hypot(down, across), _LEAST_SLOPE)
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        covered = float(np.clip(0.5 + (soft - middle) / slope, 0.0, 1.0).sum())
        low, high = (middle, high) if covered > area else (low, middle)
    return 0.5 * (low + high)
