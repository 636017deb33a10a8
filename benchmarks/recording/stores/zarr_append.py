"""zarr-python alone: one chunk per frame, `append` for each, as in its documentation."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import zarr
from zarr.codecs import ZstdCodec

from benchmarks.recording.frames import SHAPE, Frame
from benchmarks.recording.stores import FrameStore, Opened


class Store(FrameStore):
    """Array that grows by one frame at a time; its profile is the level of zstd."""

    def create(self, path: Path) -> None:
        """Create a new array."""
        codec = ZstdCodec(level=int(self.profile))
        self._array = zarr.create_array(
            path, shape=(0, *SHAPE), chunks=(1, *SHAPE), dtype="uint8", compressors=[codec]
        )

    def append(self, frame: Frame, t_ns: int) -> None:
        """Append one frame."""
        self._array.append(np.asarray(frame)[None])

    @contextmanager
    def reader(self, path: Path) -> Iterator[Opened]:
        """Yield the number of frames and a function that reads them."""
        array = zarr.open_array(path, mode="r")
        yield array.shape[0], lambda first, count: np.asarray(array[first : first + count])
