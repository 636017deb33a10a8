"""From a picture to the mask of its markers, as a preset says. OpenCV does the work."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from learning.markers.preset import (
    BlurDifference,
    CameraPreset,
    Channel,
    ColourBelow,
    Contrast,
    Dark,
    Detector,
    Region,
)
from recorder.markers import HEIGHT, WIDTH, find_blobs

Mask = NDArray[np.bool_]
Picture = np.ndarray[Any, np.dtype[Any]]
"""Pixels, uint8: OpenCV does not say so of what it returns."""
Binary = Picture

_MORPHOLOGY = {
    "open": cv2.MORPH_OPEN,
    "close": cv2.MORPH_CLOSE,
    "dilate": cv2.MORPH_DILATE,
    "erode": cv2.MORPH_ERODE,
}
_COARSE = 2
"""Extremes around a pixel are looked for at a half of the resolution: they are smooth."""


class Segmenter:
    """Makes masks from the pictures of one camera."""

    def __init__(self, preset: CameraPreset) -> None:
        """Prepare what all pictures share."""
        self.preset = preset
        self._inside = _inside(preset.region)
        shapes = {"ellipse": cv2.MORPH_ELLIPSE, "square": cv2.MORPH_RECT}
        self._elements = [
            cv2.getStructuringElement(shapes[one.shape], (one.size_px, one.size_px))
            for one in preset.morphology
        ]

    def mask(self, picture: Picture) -> Mask:
        """Return the mask (480, 640) of a picture (h, w, 3), RGB.

        Raises:
            LearningError: No such picture, or one that is smaller than the preset's region.
        """
        return self.mask_of_view(self.view(picture))

    def view(self, picture: Picture) -> Picture:
        """Return what markers are looked for in: the region of a picture as (480, 640, 3).

        Raises:
            LearningError: No such picture, or one that is smaller than the preset's region.
        """
        if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
            raise LearningError(
                f"picture: found {picture.dtype} {picture.shape}; allowed: uint8 (h, w, 3), RGB"
            )
        region = self.preset.region
        ends = []
        for name, side in (("rows", picture.shape[0]), ("columns", picture.shape[1])):
            first, last = getattr(region, name) or (0, side)
            if last > side:
                raise LearningError(
                    f"region.{name}: found {first} to {last}; the picture has {side}"
                )
            ends.append(slice(first, last))
        view = picture[ends[0], ends[1]]
        if view.shape[:2] == (HEIGHT, WIDTH):
            return view
        resized: Picture = cv2.resize(view, (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR)
        return resized

    def mask_of_view(self, view: Picture) -> Mask:
        """Return the mask (480, 640) of what `view` returned."""
        preset = self.preset
        if preset.equalise:
            view = _equalised(view)
        if preset.invert:
            view = cv2.bitwise_not(view)
        if preset.smooth_px > 1:
            view = cv2.GaussianBlur(view, (preset.smooth_px, preset.smooth_px), 0)
        found = _found(view, preset.detectors[0])
        for detector in preset.detectors[1:]:
            found = cv2.bitwise_or(found, _found(view, detector))
        if self._inside is not None:
            found = cv2.bitwise_and(found, self._inside)
        for step, element in zip(preset.morphology, self._elements, strict=True):
            found = cv2.morphologyEx(found, _MORPHOLOGY[step.step], element, iterations=step.times)
        return _of_size(found, preset.area_px)


def grey(picture: Picture) -> Picture:
    """Return the luma (h, w) of a picture (h, w, 3), RGB (ITU-R BT.601)."""
    luma: Picture = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    return luma


def _equalised(view: Picture) -> Picture:
    luma, first, second = cv2.split(cv2.cvtColor(view, cv2.COLOR_RGB2YUV))
    merged = cv2.merge([cv2.equalizeHist(luma), first, second])
    equalised: Picture = cv2.cvtColor(merged, cv2.COLOR_YUV2RGB)
    return equalised


def _found(view: Picture, detector: Detector) -> Binary:
    """Return what a detector finds (480, 640), 255 where it does."""
    if isinstance(detector, Contrast):
        return _contrast(_channel(view, detector.channel), detector)
    if isinstance(detector, BlurDifference):
        luma = grey(view)
        side = (detector.kernel_px, detector.kernel_px)
        blurred = cv2.GaussianBlur(luma, side, detector.sigma_px)
        return _below(cv2.subtract(blurred, luma), detector.least, at_least=True)
    if isinstance(detector, Dark):
        return _below(_channel(view, "brightest"), detector.below)
    limits = _limits(detector)
    within: Binary = cv2.inRange(view, (0, 0, 0), limits)
    return within


def _limits(detector: ColourBelow) -> tuple[int, int, int]:
    return detector.red - 1, detector.green - 1, detector.blue - 1


def _contrast(values: Picture, detector: Contrast) -> Binary:
    """Return where values lie beyond midway between the extremes around them."""
    small = cv2.resize(values, (WIDTH // _COARSE, HEIGHT // _COARSE), interpolation=cv2.INTER_AREA)
    side = 2 * (detector.window_px // (2 * _COARSE)) + 1
    element = cv2.getStructuringElement(cv2.MORPH_RECT, (side, side))
    low, high = cv2.erode(small, element), cv2.dilate(small, element)
    enough = _below(cv2.subtract(high, low), detector.least, at_least=True)
    middle = cv2.blur(cv2.addWeighted(low, 0.5, high, 0.5, 0), (side, side))
    middle = cv2.resize(middle, (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR)
    enough = cv2.resize(enough, (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST)
    beyond = cv2.compare(values, middle, cv2.CMP_GT if detector.bright else cv2.CMP_LT)
    found: Binary = cv2.bitwise_and(beyond, enough)
    return found


def _channel(view: Picture, channel: Channel) -> Picture:
    if channel == "grey":
        return grey(view)
    red, green, blue = cv2.split(view)
    pick = cv2.max if channel == "brightest" else cv2.min
    picked: Picture = pick(pick(red, green), blue)
    return picked


def _below(values: Picture, limit: int, *, at_least: bool = False) -> Binary:
    kind = cv2.THRESH_BINARY if at_least else cv2.THRESH_BINARY_INV
    _, binary = cv2.threshold(values, limit - 1, 255, kind)
    return np.asarray(binary, np.uint8)


def _of_size(found: Binary, area_px: tuple[int, int]) -> Mask:
    """Return the patches (connected through sides) whose areas are within limits."""
    mask = np.asarray(found != 0)
    area = find_blobs(mask[None]).area
    if ((area >= area_px[0]) & (area <= area_px[1])).all():
        # As a rule: labels of all pixels cost ten times the areas alone.
        return mask
    _, labels, stats, _ = cv2.connectedComponentsWithStats(found, connectivity=4)
    area = stats[:, cv2.CC_STAT_AREA].astype(np.int64)
    kept = (area >= area_px[0]) & (area <= area_px[1])
    kept[0] = False
    return np.asarray(kept[labels])


def _inside(region: Region) -> Binary | None:
    if not region.polygon:
        return None
    inside = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.fillPoly(inside, [np.array(region.polygon, np.int32)], 255)
    return inside
