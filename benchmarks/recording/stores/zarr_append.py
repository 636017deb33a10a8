"""zarr-python alone: one chunk per frame, `append` for each, as in its documentation."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import zarr
from zarr.codecs import ZstdCodec

from benchmarks.recording.frames import HEIGHT, WIDTH, number_in_pixels
from benchmarks.recording.stores import Image, Numbers, Opened

_LEVEL = 1


class _Appender:
    def __init__(self, path: Path) -> None:
        self._array = zarr.create_array(
            path,
            shape=(0, HEIGHT, WIDTH, 3),
            chunks=(1, HEIGHT, WIDTH, 3),
            dtype="uint8",
            compressors=[ZstdCodec(level=_LEVEL)],
        )

    def append(self, frame: Image | bytes, t_ns: int) -> None:
        self._array.append(np.asarray(frame)[None])

    def close(self) -> None:
        """Do nothing: every append is complete."""


class ZarrAppend:
    """Array that grows by one frame at a time."""

    def create(self, path: Path) -> _Appender:
        """Create a new array."""
        return _Appender(path)

    @contextmanager
    def reader(self, path: Path) -> Iterator[Opened]:
        """Yield the number of frames and a function that reads them."""
        array = zarr.open_array(path, mode="r")
        yield array.shape[0], lambda first, count: np.asarray(array[first : first + count])

    def left(self, path: Path) -> Numbers:
        """Return all declared frames; those that were never written read as zeros."""
        with self.reader(path) as (count, read):
            return [number_in_pixels(read(row, 1)[0]) for row in range(count)]

    def repaired(self, path: Path) -> None:
        """Return None: there is no repair."""
        return
