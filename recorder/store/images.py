"""Conversion between one image and the bytes of its chunk."""

import asyncio
import contextlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Self

import numcodecs.zstd
import numpy as np
import simplejpeg
import zarr
from numpy.typing import NDArray
from zarr.abc.codec import ArrayBytesCodec
from zarr.core.array_spec import ArraySpec
from zarr.core.buffer import Buffer, NDBuffer
from zarr.registry import register_codec

from recorder.errors import SessionError
from recorder.spec import Column

Image = NDArray[Any]

# Levels of zstd, for rows of numbers and for pixels. The noise of a sensor leaves little to
# compress; at a negative level zstd stores such pixels as they are (docs/results/recording.md).
ZSTD_LEVEL = 1
PIXELS_LEVEL = -1
# Stated with images kept as JPEG, for writers of other programs: the recorder encodes none.
JPEG_QUALITY = 95

# Largest header of a zstd frame [bytes].
_ZSTD_HEADER = 18
# Start of a JPEG; markers of its size, of its coded picture, and of segments without content.
_SOI, _SOF, _SOS = b"\xff\xd8", frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}, 0xDA
_STANDALONE = frozenset(range(0xD0, 0xD9)) | {0x01}
_COLORSPACE = {1: "GRAY", 3: "RGB"}


def compress(data: bytes | memoryview, level: int = ZSTD_LEVEL) -> bytes:
    """Return `data` as one zstd frame."""
    packed: bytes = numcodecs.zstd.compress(data, level)
    return packed


def decompress(data: Any, nbytes: int) -> bytes:
    """Return the content of one zstd frame, which must be `nbytes` long."""
    _check_content_size(data, nbytes)
    try:
        plain: bytes = numcodecs.zstd.decompress(data)
    except RuntimeError as error:
        raise SessionError(f"zstd: {error}") from error
    if len(plain) != nbytes:
        raise SessionError(f"zstd: found {len(plain)} bytes, expected {nbytes}")
    return plain


def _check_content_size(data: Any, nbytes: int) -> None:
    declared = _zstd_content_size(bytes(data[:_ZSTD_HEADER]))
    if declared != nbytes:
        raise SessionError(f"zstd: found {declared} bytes, expected {nbytes}")


def _zstd_content_size(data: bytes) -> int | None:
    """Return the length that the header of a zstd frame declares (RFC 8878, 3.1.1), or None."""
    if len(data) < 6 or data[:4] != b"\x28\xb5\x2f\xfd":
        return None
    flags = data[4]
    single = flags >> 5 & 1
    width = (single, 2, 4, 8)[flags >> 6]
    start = 5 + (not single) + (0, 1, 2, 4)[flags & 3]
    field = data[start : start + width]
    if not width or len(field) < width:
        return None
    return int.from_bytes(field, "little") + (256 if width == 2 else 0)


def decode_jpeg(data: bytes, shape: tuple[int, ...]) -> Image:
    """Return the pixels of a JPEG as uint8 `shape` = (h, w, 1 or 3), RGB.

    Raises:
        SessionError: Not a JPEG, corrupt, or of a different size; its size is checked first.
    """
    image = np.empty(shape, np.uint8)
    decode_jpeg_into(data, image)
    return image


def decode_jpeg_into(data: Any, out: Image) -> None:
    """Write the pixels of a JPEG, RGB, into `out` (h, w, 1 or 3) uint8, contiguous."""
    try:
        size = simplejpeg.decode_jpeg_header(data)[:2]
        if size != out.shape[:2]:
            raise SessionError(f"jpeg: found {size}, expected {out.shape}")
        simplejpeg.decode_jpeg(data, colorspace=_COLORSPACE[out.shape[2]], buffer=out)
    except ValueError as error:
        raise SessionError(f"jpeg: {error}") from error


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
    """Return the function that decodes an image column's chunk to pixels."""
    dtype = np.dtype(column.dtype).newbyteorder("<")
    into = decoder_into(column.codec, math.prod(column.shape) * dtype.itemsize)

    def decode(data: bytes) -> Image:
        out = np.empty(column.shape, dtype)
        into(data, out)
        return out

    return decode


def decoder_into(codec: str, nbytes: int) -> Callable[[Any, Image], None]:
    """Return the function that decodes a chunk into a contiguous image of `nbytes`."""
    if codec == "jpeg":
        return decode_jpeg_into

    def decode(data: Any, out: Image) -> None:
        _check_content_size(data, nbytes)
        try:
            numcodecs.zstd.decompress(data, out.reshape(-1).view(np.uint8))
        except RuntimeError as error:
            raise SessionError(f"zstd: {error}") from error

    return decode


def encoder(column: Column, where: str) -> Callable[[object], bytes]:
    """Return the function that encodes an appended value as the bytes of its chunk.

    A `jpeg` column takes JPEG bytes and stores them unchanged; a `zstd` column takes pixels.
    """
    expected = f"{column.dtype} {column.shape}"
    dtype = np.dtype(column.dtype)

    offset, tables = 0, b""

    def keep(value: object) -> bytes:
        nonlocal offset, tables
        if not isinstance(value, (bytes, bytearray, memoryview)):
            raise SessionError(
                f"{where}: found {type(value).__name__}, expected JPEG bytes of {expected} "
                "(declare codec 'zstd' to store pixels)"
            )
        data = bytes(value)
        # One camera's headers are alike: the decoder is asked only if size or tables have changed.
        if tables and data.startswith(_SOI) and data.startswith(tables, offset):
            return data
        try:
            height, width, *_ = simplejpeg.decode_jpeg_header(data)
        except ValueError as error:
            raise SessionError(f"{where}: found no JPEG ({error}), expected {expected}") from error
        if (height, width) != column.shape[:2]:
            raise SessionError(f"{where}: found JPEG {height}x{width}, expected {expected}")
        offset, tables = _frame_header(data)
        return data

    def pack(value: object) -> bytes:
        if not isinstance(value, np.ndarray):
            raise SessionError(f"{where}: found {type(value).__name__}, expected pixels {expected}")
        if value.dtype != dtype or value.shape != column.shape:
            raise SessionError(f"{where}: found {value.dtype} {value.shape}, expected {expected}")
        plain = np.ascontiguousarray(value, dtype.newbyteorder("<"))
        return compress(plain.data.cast("B"), PIXELS_LEVEL)

    return keep if column.codec == "jpeg" else pack


def _frame_header(data: bytes) -> tuple[int, bytes]:
    """Return offset and bytes of a JPEG's segments from SOF to SOS; empty if not found."""
    offset = 0
    with contextlib.suppress(ValueError):
        for marker, at, content in jpeg_segments(data):
            if marker in _SOF:
                offset = offset or at
            elif marker == _SOS and offset:
                return offset, data[offset : at + 4 + len(content)]
    return 0, b""


def jpeg_segments(jpeg: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Yield marker, offset and content of each segment of a JPEG up to and including SOS.

    A file is SOI (FFD8), segments (FF, marker, uint16 length that counts itself, content), the last
    of them SOS followed by the coded picture, and EOI (FFD9).

    Raises:
        ValueError: Another kind of file, or one that ends before SOS.
    """
    if jpeg[:2] != _SOI:
        raise ValueError("no SOI")
    at = 2
    while at + 4 <= len(jpeg):
        if jpeg[at] != 0xFF:
            raise ValueError(f"no marker at byte {at}")
        marker = jpeg[at + 1]
        if marker == 0xFF or marker in _STANDALONE:
            at += 1 if marker == 0xFF else 2
            continue
        length = int.from_bytes(jpeg[at + 2 : at + 4], "big")
        if length < 2 or at + 2 + length > len(jpeg):
            raise ValueError(f"segment {marker:02X} at byte {at} is cut off")
        yield marker, at, jpeg[at + 4 : at + 2 + length]
        if marker == _SOS:
            return
        at += 2 + length
    raise ValueError("no SOS")


# `imagecodecs_jpeg` for zarr-python: reads images stored as the camera's original JPEG.
#
# Name and configuration are those of `imagecodecs.zarr`, which offers the same codec on
# Python 3.12 and later. The bytes are plain JPEG, so each codec reads the files of the other.

NAME = "imagecodecs_jpeg"


@dataclass(frozen=True)
class JpegCodec(ArrayBytesCodec):
    """One image per chunk, as JPEG."""

    is_fixed_size = False

    level: int = JPEG_QUALITY
    """Quality for writers of other programs."""

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """Return the codec described by an array's metadata; unused keys are ignored."""
        configuration = data.get("configuration", {})
        return cls(level=int(configuration.get("level", JPEG_QUALITY)))

    def to_dict(self) -> dict[str, Any]:
        """Return the metadata of this codec."""
        return {"name": NAME, "configuration": {"level": self.level}}

    def compute_encoded_size(self, input_byte_length: int, chunk_spec: ArraySpec) -> int:
        """Raise NotImplementedError: the size is not known before encoding."""
        raise NotImplementedError

    def _decode_sync(self, chunk: Buffer, spec: ArraySpec) -> NDBuffer:
        pixels = decode_jpeg(chunk.to_bytes(), tuple(spec.shape[-3:]))
        return spec.prototype.nd_buffer.from_numpy_array(pixels.reshape(spec.shape))

    async def _decode_single(self, chunk_data: Buffer, chunk_spec: ArraySpec) -> NDBuffer:
        return await asyncio.to_thread(self._decode_sync, chunk_data, chunk_spec)


# zarr-python uses this codec for the name, even if others provide it too, and without this setting
# warns if imagecodecs has registered the same name.
register_codec(NAME, JpegCodec)
zarr.config.set({f"codecs.{NAME}": f"{JpegCodec.__module__}.{JpegCodec.__qualname__}"})
