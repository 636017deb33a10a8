"""One image <-> the bytes of its chunk."""

from collections.abc import Callable

import numcodecs.zstd
import numpy as np
import simplejpeg
from numpy.typing import NDArray

from recorder.errors import SessionError
from recorder.spec import Column

Image = NDArray[np.uint8]

ZSTD_LEVEL = 1
JPEG_QUALITY = 95
"""Used only where somebody writes pixels through Zarr: the recorder never encodes a JPEG."""

_COLORSPACE = {1: "GRAY", 3: "RGB"}


def compress(data: bytes | memoryview) -> bytes:
    """Return `data` as one zstd frame."""
    packed: bytes = numcodecs.zstd.compress(data, ZSTD_LEVEL)
    return packed


def decompress(data: bytes) -> bytes:
    """Return the content of one zstd frame.

    Raises:
        SessionError: The frame is damaged.
    """
    try:
        plain: bytes = numcodecs.zstd.decompress(data)
    except RuntimeError as error:
        raise SessionError(f"zstd: {error}") from error
    return plain


def decode_jpeg(data: bytes, shape: tuple[int, ...]) -> Image:
    """Return the pixels of a JPEG as uint8 `shape` = (h, w, 1 or 3), RGB.

    Raises:
        SessionError: Not a JPEG, damaged, or of another size.
    """
    try:
        image: Image = simplejpeg.decode_jpeg(data, colorspace=_COLORSPACE[shape[2]])
    except ValueError as error:
        raise SessionError(f"jpeg: {error}") from error
    if image.shape != shape:
        raise SessionError(f"jpeg: found {image.shape}, expected {shape}")
    return image


def encode_jpeg(image: Image, quality: int) -> bytes:
    """Return pixels (h, w, 1 or 3), RGB, as JPEG without chroma subsampling."""
    data: bytes = simplejpeg.encode_jpeg(
        np.ascontiguousarray(image),
        quality=quality,
        colorspace=_COLORSPACE[image.shape[2]],
        colorsubsampling="Gray" if image.shape[2] == 1 else "444",
    )
    return data


def decoder(column: Column) -> Callable[[bytes], Image]:
    """Return the function from an image column's chunk to its pixels."""
    shape = column.shape
    if column.codec == "jpeg":
        return lambda data: decode_jpeg(data, shape)

    def decode(data: bytes) -> Image:
        pixels = np.frombuffer(decompress(data), np.uint8)
        if pixels.size != column.row_bytes:
            raise SessionError(f"zstd: found {pixels.size} bytes, expected {column.row_bytes}")
        return pixels.reshape(shape)

    return decode


def encoder(column: Column, where: str) -> Callable[[object], bytes]:
    """Return the function from what a caller appends to the bytes of its chunk.

    A `jpeg` column takes JPEG bytes and keeps them as they are; a `zstd` column takes pixels.
    """
    expected = f"uint8 {column.shape}"

    def keep(value: object) -> bytes:
        if not isinstance(value, bytes | bytearray | memoryview):
            raise SessionError(
                f"{where}: found {type(value).__name__}, expected JPEG bytes of {expected} "
                "(declare codec 'zstd' to store pixels)"
            )
        data = bytes(value)
        try:
            height, width, *_ = simplejpeg.decode_jpeg_header(data)
        except ValueError as error:
            raise SessionError(f"{where}: found no JPEG ({error}), expected {expected}") from error
        if (height, width) != column.shape[:2]:
            raise SessionError(f"{where}: found JPEG {height}x{width}, expected {expected}")
        return data

    def pack(value: object) -> bytes:
        if not isinstance(value, np.ndarray):
            raise SessionError(f"{where}: found {type(value).__name__}, expected pixels {expected}")
        if value.dtype != np.uint8 or value.shape != column.shape:
            raise SessionError(f"{where}: found {value.dtype} {value.shape}, expected {expected}")
        return compress(np.ascontiguousarray(value).data.cast("B"))

    return keep if column.codec == "jpeg" else pack
