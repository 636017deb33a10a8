"""Marker images as networks see them: 256 x 256, one channel, anti-aliased, and back again.

Shrinking is the exact mean over 2.5 columns and 1.875 rows, so that a marker's edge keeps its
place between pixels. Enlarging is what the authors' inference does: Lanczos to 640 x 480, then
everything above 128. Both exist for arrays and for tensors, which may lie on a GPU.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from learning.errors import LearningError
from recorder.markers import HEIGHT, PACKED, WIDTH, pack, unpack

SIDE = 256
"""Rows and columns of an image [px]."""
ABOVE = 128
"""Grey level above which an enlarged pixel is a marker's (authors' code)."""

_AT_ONCE = 64
"""Images that are worked on together: unpacked they take 20 MB."""
_ROWS, _COLUMNS = 15, 5
"""Of so many rows 8 are made, and of so many columns 2."""
_WHOLE = 75
"""Sum of the weights of one pixel: 15 eighths of rows by 5 halves of columns."""
_LOBES, _BITS = 3, 22
"""Of Pillow's Lanczos kernel: zeros on each side, and bits of its weights."""


def shrink(packed: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return packed masks (n, 38400) as images (n, 256, 256), 255 where all is marker.

    Raises:
        LearningError: Not packed masks.
    """
    _require(packed, np.dtype(np.uint8), (PACKED,), "packed masks")
    images = np.empty((len(packed), SIDE, SIDE), np.uint8)
    for first in range(0, len(packed), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        masks = unpack(packed[part]).view(np.uint8)
        images[part] = _grey_levels()[_summed(masks, np.stack)]
    return images


def enlarge(images: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return images (n, 256, 256) as packed masks (n, 38400): Pillow's Lanczos, then > 128.

    Raises:
        LearningError: Not images.
    """
    _require(images, np.dtype(np.uint8), (SIDE, SIDE), "images")
    packed = np.empty((len(images), PACKED), np.uint8)
    for row, image in enumerate(images):
        large = Image.fromarray(image).resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS)
        packed[row] = pack(np.asarray(large) > ABOVE)
    return packed


def shrink_masks(masks: Tensor) -> Tensor:
    """Return masks (n, 480, 640) bool as images (n, 256, 256) uint8, those of `shrink`.

    Raises:
        LearningError: Not masks.
    """
    _require(masks, torch.bool, (HEIGHT, WIDTH), "masks")
    images = torch.empty((len(masks), SIDE, SIDE), dtype=torch.uint8, device=masks.device)
    levels = torch.from_numpy(_grey_levels()).to(masks.device)
    for first in range(0, len(masks), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        images[part] = levels[_summed(masks[part].view(torch.uint8), torch.stack).int()]
    return images


def enlarge_images(images: Tensor) -> Tensor:
    """Return images (n, 256, 256) uint8 as masks (n, 480, 640) bool.

    They are those of `enlarge` but for pixels that come within rounding of the threshold.

    Raises:
        LearningError: Not images.
    """
    _require(images, torch.uint8, (SIDE, SIDE), "images")
    masks = torch.empty((len(images), HEIGHT, WIDTH), dtype=torch.bool, device=images.device)
    across, down = (
        torch.from_numpy(_lanczos(side)).to(images.device, torch.float32)
        for side in (WIDTH, HEIGHT)
    )
    # Weights in bfloat16 would move edges.
    with torch.autocast(images.device.type, enabled=False):
        for first in range(0, len(images), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            # Pillow rounds to grey levels between its two passes, columns first.
            wide = (images[part].float() @ across.T).round_().clamp_(0, 255)
            masks[part] = (down @ wide).round_() > ABOVE
    return masks


def unpack_masks(packed: Tensor) -> Tensor:
    """Return packed masks (n, 38400) uint8 as masks (n, 480, 640) bool, on their device.

    Raises:
        LearningError: Not packed masks.
    """
    _require(packed, torch.uint8, (PACKED,), "packed masks")
    bits = packed.unsqueeze(-1) & _bits(packed.device)
    return (bits != 0).view(len(packed), HEIGHT, WIDTH)


def pack_masks(masks: Tensor) -> Tensor:
    """Return masks (n, 480, 640) bool as packed masks (n, 38400) uint8, on their device.

    Raises:
        LearningError: Not masks.
    """
    _require(masks, torch.bool, (HEIGHT, WIDTH), "masks")
    bits = masks.reshape(len(masks), PACKED, 8).view(torch.uint8) * _bits(masks.device)
    return bits.sum(dim=-1, dtype=torch.uint8)


def _bits(device: torch.device) -> Tensor:
    return torch.tensor([128, 64, 32, 16, 8, 4, 2, 1], dtype=torch.uint8, device=device)


def _summed(masks: Any, stack: Callable[..., Any]) -> Any:
    """Return weighted sums (n, 256, 256), 0 to 75, of masks (n, 480, 640) uint8 of 0 and 1."""
    blocks = masks.reshape(len(masks), -1, _ROWS, WIDTH)
    rows = []
    for each in range(8):
        total = None
        for row in range(_ROWS * each // 8, -(-_ROWS * (each + 1) // 8)):
            # Eighths of this row that lie between 15/8 each and 15/8 (each + 1).
            weight = min(8 * row + 8, _ROWS * (each + 1)) - max(8 * row, _ROWS * each)
            part = blocks[:, :, row] * weight
            total = part if total is None else total + part
        rows.append(total)
    high = stack(rows, 2).reshape(len(masks), SIDE, SIDE // 2, _COLUMNS)
    middle = high[..., 2]
    left = 2 * (high[..., 0] + high[..., 1]) + middle
    right = 2 * (high[..., 3] + high[..., 4]) + middle
    return stack([left, right], 3).reshape(len(masks), SIDE, SIDE)


@functools.cache
def _grey_levels() -> NDArray[np.uint8]:
    """Grey level of each weighted sum."""
    return np.round(np.arange(_WHOLE + 1) * (255 / _WHOLE)).astype(np.uint8)


@functools.cache
def _lanczos(side: int) -> NDArray[np.float64]:
    """Weights (side, 256) with which Pillow resizes 256 pixels to more of them."""
    scale = SIDE / side
    centres = (np.arange(side) + 0.5) * scale
    first = np.maximum((centres - _LOBES + 0.5).astype(int), 0)
    end = np.minimum((centres + _LOBES + 0.5).astype(int), SIDE)
    pixels = np.arange(SIDE)
    distance = pixels[None, :] + 0.5 - centres[:, None]
    weights = np.sinc(distance) * np.sinc(distance / _LOBES)
    inside = (pixels >= first[:, None]) & (pixels < end[:, None]) & (np.abs(distance) < _LOBES)
    weights = np.where(inside, weights, 0.0)
    weights /= weights.sum(axis=1, keepdims=True)
    rounded: NDArray[np.float64] = np.round(weights * 2**_BITS) / 2**_BITS
    return rounded


def _require(values: Any, dtype: Any, shape: tuple[int, ...], what: str) -> None:
    if values.dtype != dtype or tuple(values.shape[1:]) != shape or values.ndim != len(shape) + 1:
        raise LearningError(
            f"{what}: found {values.dtype} {tuple(values.shape)}; allowed: {dtype} "
            f"(n, {', '.join(map(str, shape))})"
        )
