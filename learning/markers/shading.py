"""Shading of a gel without markers: the change of its colours from those without contact."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from learning.markers.segment import ShadingPreset, view_of
from recorder.archive import SHADING_SIDE, SHADING_ZERO

Cells = NDArray[np.float32]


def cells_of(picture: NDArray[Any], preset: ShadingPreset) -> Cells:
    """Return the mean colours (3, 128, 128) of the cells of a picture (h, w, 3) uint8, RGB."""
    view = view_of(picture, preset.region).astype(np.float32)
    small = cv2.resize(view, (SHADING_SIDE, SHADING_SIDE), interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(np.moveaxis(np.asarray(small, np.float32), 2, 0))


def shading_of(cells: Cells, no_contact: Cells) -> NDArray[np.uint8]:
    """Return frames (..., 3, 128, 128) uint8: the change of colours plus 128, cut to 0 to 255."""
    change = np.rint(cells - no_contact) + SHADING_ZERO
    return np.asarray(np.clip(change, 0, 255), np.uint8)


def change_of(shading: NDArray[np.uint8]) -> float:
    """Return the mean size of the change in a frame (3, 128, 128) [grey levels]."""
    return float(np.abs(shading.astype(np.int16) - SHADING_ZERO).mean())


def picture_of(shading: NDArray[np.uint8], times: float = 4.0) -> NDArray[np.uint8]:
    """Return a frame as a picture (128, 128, 3), RGB, whose changes are enlarged."""
    change = (np.moveaxis(shading, 0, 2).astype(np.float32) - SHADING_ZERO) * times
    return np.asarray(np.clip(change + SHADING_ZERO, 0, 255), np.uint8)
