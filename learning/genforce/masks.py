"""Mask files: packed bits in .npy, plain arrays in .npy, pictures in .jpg."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from learning.errors import LearningError
from recorder.markers import HEIGHT, PACKED, WIDTH, pack

SUFFIXES = (".npy", ".jpg")
WHITE_ABOVE = 50
"""A pixel of a picture is a marker's above this grey of 255."""

Packed = NDArray[np.uint8]


def read_mask(path: Path) -> Packed:
    """Return the packed mask (38400,) in a file.

    Raises:
        LearningError: Not there, damaged, or of another size: the message names the file.
    """
    if path.suffix == ".npy":
        return _of_array(read_array(path), path)
    return pack(_greys(path) > WHITE_ABOVE)


def write_mask(path: Path, packed: Packed) -> None:
    """Write a packed mask (38400,) as `numpy.save` does."""
    np.save(path, packed, allow_pickle=False)


def read_array(path: Path) -> NDArray[np.generic]:
    """Return the array in a .npy file.

    Raises:
        LearningError: Not there, cut short, or no such file.
    """
    try:
        array: NDArray[np.generic] = np.load(path, allow_pickle=False)
    except FileNotFoundError:
        raise LearningError(f"{path}: no such file") from None
    except (ValueError, EOFError) as error:
        size = path.stat().st_size
        raise LearningError(f"{path}: {size} bytes, no whole .npy file: {error}") from error
    if not isinstance(array, np.ndarray):
        raise LearningError(f"{path}: found an archive of arrays; expected one array")
    return array


def _greys(path: Path) -> NDArray[np.uint8]:
    """Return the pixels (480, 640) of a picture.

    Raises:
        LearningError: Not there, cut short, or of another size.
    """
    try:
        with Image.open(path) as picture:
            pixels = np.asarray(picture.convert("L"))
    except FileNotFoundError:
        raise LearningError(f"{path}: no such file") from None
    except (UnidentifiedImageError, OSError) as error:
        raise LearningError(f"{path}: no whole picture: {error}") from error
    if pixels.shape[:2] != (HEIGHT, WIDTH):
        found = f"{pixels.shape[1]} x {pixels.shape[0]}"
        raise LearningError(f"{path}: found {found} pixels; expected {WIDTH} x {HEIGHT}")
    return pixels


def _of_array(array: NDArray[np.generic], path: Path) -> Packed:
    if array.dtype == np.uint8 and array.shape == (PACKED,):
        return np.asarray(array, np.uint8)
    if array.shape != (HEIGHT, WIDTH) or array.dtype.kind not in "buif":
        raise LearningError(
            f"{path}: found {array.dtype} {array.shape}; expected uint8 ({PACKED},), packed bits, "
            f"or ({HEIGHT}, {WIDTH})"
        )
    values = array.astype(np.float64)
    if not np.isfinite(values).all():
        raise LearningError(f"{path}: found NaN or infinity; expected 0 and 1, or greys")
    # Greys go up to 255, flags to 1.
    return pack(values > (WHITE_ABOVE if values.max() > 1 else 0))
