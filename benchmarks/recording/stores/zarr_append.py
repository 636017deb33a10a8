"""zarr-python alone: one chunk per frame, `append` for each, as in its documentation."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import zarr
from zarr.codecs import ZstdCodec

from benchmarks.recording.frames import HEIGHT, WIDTH
from benchmarks.recording.stores import Appender, Frame, FrameStore, Opened


class _Appender(Appender):
    def __init__(self, path: Path, level: int) -> None:
        self._array = zarr.create_array(
            path,
            shape=(0, HEIGHT, WIDTH, 3),
            chunks=(1, HEIGHT, WIDTH, 3),
            dtype="uint8",
            compressors=[ZstdCodec(level=level)],
        )

    def append(self, frame: Frame, t_ns: int) -> None:
        self._array.append(np.asarray(frame)[None])


class Store(FrameStore):
    """Array that grows by one frame at a time.

    Args:
        profile: Codec and level.
    """

    def __init__(self, profile: str) -> None:
        self._level = int(profile.split()[-1])

    def create(self, path: Path) -> _Appender:
        """Create a new array."""
        return _Appender(path, self._level)

    @contextmanager
    def reader(self, path: Path) -> Iterator[Opened]:
        """Yield the number of frames and a function that reads them."""
        array = zarr.open_array(path, mode="r")
        yield array.shape[0], lambda first, count: np.asarray(array[first : first + count])
