"""`imagecodecs_jpeg` for zarr-python: reads images that were stored as the camera's own JPEG.

The name and the configuration are those of `imagecodecs.zarr`, which offers the same codec on
Python 3.12 and later; the bytes are plain JPEG, so either reads what the other wrote.
"""

import asyncio
from dataclasses import dataclass
from typing import Any, Self

import zarr
from zarr.abc.codec import ArrayBytesCodec
from zarr.core.array_spec import ArraySpec
from zarr.core.buffer import Buffer, NDBuffer
from zarr.registry import register_codec

from recorder import images

NAME = "imagecodecs_jpeg"


@dataclass(frozen=True)
class JpegCodec(ArrayBytesCodec):
    """One image per chunk, as JPEG."""

    is_fixed_size = False

    level: int = images.JPEG_QUALITY
    """Quality of what is written through Zarr; reading does not use it."""

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """Return the codec that an array's metadata names; keys it does not use are ignored."""
        configuration = data.get("configuration", {})
        return cls(level=int(configuration.get("level", images.JPEG_QUALITY)))

    def to_dict(self) -> dict[str, Any]:
        """Return the metadata of this codec."""
        return {"name": NAME, "configuration": {"level": self.level}}

    def compute_encoded_size(self, input_byte_length: int, chunk_spec: ArraySpec) -> int:
        """Not known before encoding."""
        raise NotImplementedError

    def _decode_sync(self, chunk: Buffer, spec: ArraySpec) -> NDBuffer:
        pixels = images.decode_jpeg(chunk.to_bytes(), tuple(spec.shape[-3:]))
        return spec.prototype.nd_buffer.from_numpy_array(pixels.reshape(spec.shape))

    def _encode_sync(self, chunk: NDBuffer, spec: ArraySpec) -> Buffer:
        pixels = chunk.as_numpy_array().reshape(spec.shape[-3:])
        return spec.prototype.buffer.from_bytes(images.encode_jpeg(pixels, self.level))

    async def _decode_single(self, chunk_data: Buffer, chunk_spec: ArraySpec) -> NDBuffer:
        return await asyncio.to_thread(self._decode_sync, chunk_data, chunk_spec)

    async def _encode_single(self, chunk_data: NDBuffer, chunk_spec: ArraySpec) -> Buffer:
        return await asyncio.to_thread(self._encode_sync, chunk_data, chunk_spec)


def register() -> None:
    """Make zarr-python use this codec for `imagecodecs_jpeg`, whoever else offers it."""
    register_codec(NAME, JpegCodec)
    # Without a choice zarr-python warns when imagecodecs has registered the same name.
    zarr.config.set({f"codecs.{NAME}": f"{JpegCodec.__module__}.{JpegCodec.__qualname__}"})
