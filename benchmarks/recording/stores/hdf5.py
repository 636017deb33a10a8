"""HDF5 through h5py, default settings: one chunk per frame, or the JPEG as a byte array."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import simplejpeg

from benchmarks.recording.frames import HEIGHT, WIDTH
from benchmarks.recording.stores import (
    Appender,
    Frame,
    FrameStore,
    Image,
    Numbers,
    Opened,
    number_in,
)

_NAME = "frames"


class _Appender(Appender):
    def __init__(self, path: Path, profile: str) -> None:
        self._file = h5py.File(path, "w")
        self._count = 0
        if profile == "jpeg":
            kind = h5py.vlen_dtype(np.uint8)
            self._data = self._file.create_dataset(_NAME, (0,), kind, maxshape=(None,))
            return
        filters: dict[str, Any] = {"compression": "gzip", "compression_opts": 1}
        if profile == "blosc":
            import hdf5plugin

            filters = dict(hdf5plugin.Blosc("lz4", clevel=5, shuffle=hdf5plugin.Blosc.BITSHUFFLE))
        shape = (HEIGHT, WIDTH, 3)
        self._data = self._file.create_dataset(
            _NAME, (0, *shape), np.uint8, maxshape=(None, *shape), chunks=(1, *shape), **filters
        )

    def append(self, frame: Frame, t_ns: int) -> None:
        self._count += 1
        self._data.resize(self._count, axis=0)
        value = np.frombuffer(frame, np.uint8) if isinstance(frame, bytes) else frame
        self._data[self._count - 1] = value

    def close(self) -> None:
        self._file.close()


class Store(FrameStore):
    """One file.

    Args:
        profile: `blosc`, `gzip` or `jpeg`.
    """

    def __init__(self, profile: str) -> None:
        self._profile = profile

    def create(self, path: Path) -> _Appender:
        """Create a new file."""
        return _Appender(path, self._profile)

    @contextmanager
    def reader(self, path: Path) -> Iterator[Opened]:
        """Yield the number of frames and a function that reads them."""
        with h5py.File(path, "r") as file:
            data = file[_NAME]

            def read(first: int, count: int) -> Image:
                return np.asarray(data[first : first + count])

            def read_jpeg(first: int, count: int) -> Image:
                out = np.empty((count, HEIGHT, WIDTH, 3), np.uint8)
                for image, row in zip(out, data[first : first + count], strict=True):
                    simplejpeg.decode_jpeg(row, buffer=image)
                return out

            yield len(data), read_jpeg if self._profile == "jpeg" else read

    def left(self, path: Path) -> Numbers:
        """Return the frames that h5py finds; it rejects a file that was not closed and flushed."""
        if self._profile != "jpeg":
            return super().left(path)
        with h5py.File(path, "r") as file:
            return [number_in(row.tobytes()) for row in file[_NAME]]
