"""Masks packed at one bit per pixel, as in the published recordings.

Row-major, with the first pixel in the highest bit of the first byte (`numpy.packbits`, big-endian).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Size of every marker image [px].
WIDTH, HEIGHT = 640, 480
# Bytes of a packed mask.
PACKED = WIDTH * HEIGHT // 8

Masks = NDArray[np.bool_]
Packed = NDArray[np.uint8]


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
