"""Masks of marker images: packed bits, and their connected patches, with numpy alone.

Masks are packed at one bit per pixel, as in the published recordings: row-major, with the first
pixel in the highest bit of the first byte (`numpy.packbits`, big-endian).

Pixels are connected through their sides, not their corners (4-connectivity). Patches are built from
runs of set pixels, for many frames at once: touching runs in neighbouring rows are joined, and each
run is labelled with the number of the first run that it is connected to.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Size of every marker image [px].
WIDTH, HEIGHT = 640, 480
# Bytes of a packed mask.
PACKED = WIDTH * HEIGHT // 8

Masks = NDArray[np.bool_]
Packed = NDArray[np.uint8]
Integers = NDArray[np.int64]

# Smaller patches are specks, not markers: the smallest marker of the patterns has 50 pixels.
SMALLEST_PX = 12
_BLOCK = 64  # frames processed at once


def pack(masks: Masks) -> Packed:
    """Return masks (..., 480, 640) as packed bits (..., 38400).

    Raises:
        ValueError: Not bool, or not 480 x 640.
    """
    require_masks(masks)
    return np.packbits(masks.reshape(*masks.shape[:-2], HEIGHT * WIDTH), axis=-1)


def unpack(packed: Packed) -> Masks:
    """Return packed bits (..., 38400) as masks (..., 480, 640).

    Raises:
        ValueError: Not uint8, or not 38400 bytes each.
    """
    if packed.dtype != np.uint8 or packed.shape[-1:] != (PACKED,):
        raise ValueError(
            f"packed: found {packed.dtype} {packed.shape}; expected uint8 (..., {PACKED})"
        )
    masks: Masks = np.unpackbits(packed, axis=-1).view(np.bool_)
    return masks.reshape(*packed.shape[:-1], HEIGHT, WIDTH)


def require_masks(masks: Masks) -> None:
    """Reject arrays that are neither a mask nor a batch of masks."""
    if masks.dtype != np.bool_ or masks.shape[-2:] != (HEIGHT, WIDTH):
        raise ValueError(
            f"masks: found {masks.dtype} {masks.shape}; expected bool (..., {HEIGHT}, {WIDTH})"
        )


@dataclass(frozen=True, slots=True)
class Blobs:
    """Patches of some masks, ordered by frame and then from top to bottom."""

    frame: Integers
    """Number of the mask (m,)."""
    area: Integers
    """Number of pixels (m,)."""
    centre: NDArray[np.float64]
    """Mean column and row (m, 2) [px]."""
    whole: NDArray[np.bool_]
    """True if no pixel is on the border of the image (m,), so that nothing is cut off."""

    def __len__(self) -> int:
        return len(self.frame)

    def only(self, chosen: NDArray[np.bool_] | slice) -> Blobs:
        """Return a subset of the patches."""
        return Blobs(self.frame[chosen], self.area[chosen], self.centre[chosen], self.whole[chosen])


def count_markers(mask: Masks, smallest_px: int = SMALLEST_PX) -> int:
    """Return the number of patches of at least `smallest_px` pixels in one mask (h, w).

    Raises:
        ValueError: Not one bool image.
    """
    return len(find_blobs(_one(mask), smallest_px))


def smallest_marker(mask: Masks) -> int:
    """Return the area that a marker of one mask (h, w) has at least [px]: fragments are smaller.

    It is a fifth of the patches' median area, and `SMALLEST_PX` at least.

    Raises:
        ValueError: Not one bool image.
    """
    area = find_blobs(_one(mask), SMALLEST_PX).area
    return max(SMALLEST_PX, round(float(np.median(area)) / 5) if len(area) else 0)


def marker_centres(mask: Masks) -> NDArray[np.float64]:
    """Return the mean column and row (m, 2) [px] of the markers in one mask (h, w).

    Raises:
        ValueError: Not one bool image.
    """
    return find_blobs(_one(mask), SMALLEST_PX).centre


def find_blobs(masks: Masks, smallest_px: int = 1) -> Blobs:
    """Return the patches of masks (n, h, w) that have at least `smallest_px` pixels.

    Raises:
        ValueError: Not bool (n, h, w).
    """
    if masks.dtype != np.bool_ or masks.ndim != 3:
        raise ValueError(f"masks: found {masks.dtype} {masks.shape}; expected bool (n, h, w)")
    starts = range(0, max(len(masks), 1), _BLOCK)
    parts = [_find(masks[first : first + _BLOCK], first) for first in starts]
    blobs = Blobs(
        np.concatenate([part.frame for part in parts]),
        np.concatenate([part.area for part in parts]),
        np.concatenate([part.centre for part in parts]),
        np.concatenate([part.whole for part in parts]),
    )
    return blobs.only(blobs.area >= smallest_px)


def _one(mask: Masks) -> Masks:
    if mask.ndim != 2:
        raise ValueError(f"mask: found {mask.dtype} {mask.shape}; expected one bool (h, w)")
    return mask[None]


def _find(masks: Masks, first_frame: int) -> Blobs:
    height, width = masks.shape[1:]
    line, left, right = _runs(masks)
    patch = _patches(*_touching(line, left, right, height, width), len(line))
    row, pixels = line % height, right - left
    count = int(patch.max(initial=-1)) + 1
    area = np.bincount(patch, pixels, count)
    column_sum = np.bincount(patch, 0.5 * (left + right - 1) * pixels, count)
    row_sum = np.bincount(patch, row * pixels, count)
    cut = (row == 0) | (row == height - 1) | (left == 0) | (right == width)
    frame = np.zeros(count, np.int64)
    frame[patch] = line // height + first_frame
    return Blobs(
        frame,
        area.astype(np.int64),
        np.stack([column_sum / area, row_sum / area], axis=-1),
        np.bincount(patch, cut, count) == 0,
    )


def _runs(masks: Masks) -> tuple[Integers, Integers, Integers]:
    """Return the runs of set pixels: line (over all frames), first column, end column."""
    frames, height, width = masks.shape
    # With an unset pixel at both ends of a line, every run begins and ends within it.
    framed = np.zeros((frames, height, width + 2), np.bool_)
    framed[..., 1:-1] = masks
    changes = np.flatnonzero(framed[..., 1:] != framed[..., :-1])
    line, left = np.divmod(changes[0::2], width + 1)
    return line, left, changes[1::2] - line * (width + 1)


def _touching(
    line: Integers, left: Integers, right: Integers, height: int, width: int
) -> tuple[Integers, Integers]:
    """Return the pairs of runs (e,), (e,) in consecutive rows that share a side."""
    pitch = width + 1
    below = (line + 1) * pitch
    begin = np.searchsorted(line * pitch + right, below + left, side="right")
    end = np.searchsorted(line * pitch + left, below + right, side="left")
    # The last line of a frame is followed by a line of the next frame.
    count = np.where((line + 1) % height == 0, 0, np.maximum(end - begin, 0))
    upper = np.repeat(np.arange(len(line)), count)
    before = np.repeat(np.cumsum(count) - count, count)
    return upper, np.arange(len(upper)) - before + np.repeat(begin, count)


def _patches(upper: Integers, lower: Integers, runs: int) -> Integers:
    """Return the patch number of each run (runs,), numbered by their first runs.

    Every run points to an earlier run of its patch or to itself. Each round joins the patches of
    touching runs at their roots and compresses all paths to one step, so that rounds are few.
    """
    root = np.arange(runs)
    while True:
        first, second = root[upper], root[lower]
        if np.array_equal(first, second):
            break
        least = np.minimum(first, second)
        np.minimum.at(root, first, least)
        np.minimum.at(root, second, least)
        while not np.array_equal(shorter := root[root], root):
            root = shorter
    return np.unique(root, return_inverse=True)[1]
