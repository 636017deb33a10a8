"""HDF5 through h5py, default settings: one chunk per frame, or the JPEG as a byte array."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from benchmarks.recording.frames import SHAPE, Frame, Image, decoded, number_in
from benchmarks.recording.stores import FrameStore, Numbers, Opened

_NAME = "frames"


class Store(FrameStore):
    """One file, of profile `blosc`, `gzip` or `jpeg`."""

    def __init__(self, profile: str) -> None:
        super().__init__(profile)
        self._filters: dict[str, Any] = {"compression": "gzip", "compression_opts": 1}
        if profile == "blosc":
            from hdf5plugin import Blosc  # also makes it readable

            self._filters = dict(Blosc("lz4", clevel=5, shuffle=Blosc.BITSHUFFLE))

    def create(self, path: Path) -> None:
        """Create a new file."""
        self._file, self._count = h5py.File(path, "w"), 0
        if self.profile == "jpeg":
            kind = h5py.vlen_dtype(np.uint8)
            self._data = self._file.create_dataset(_NAME, (0,), kind, maxshape=(None,))
            return
        self._data = self._file.create_dataset(
            _NAME, (0, *SHAPE), "u1", maxshape=(None, *SHAPE), chunks=(1, *SHAPE), **self._filters
        )

    def append(self, frame: Frame, t_ns: int) -> None:
        """Append one frame."""
        self._count += 1
        self._data.resize(self._count, axis=0)
        value = np.frombuffer(frame, np.uint8) if isinstance(frame, bytes) else frame
        self._data[self._count - 1] = value

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @contextmanager
    def reader(self, path: Path) -> Iterator[Opened]:
        """Yield the number of frames and a function that reads them."""
        with h5py.File(path, "r") as file:
            data = file[_NAME]

            def read(first: int, count: int) -> Image:
                rows = data[first : first + count]
                return decoded(rows, count) if self.profile == "jpeg" else np.asarray(rows)

            yield len(data), read

    def left(self, path: Path) -> Numbers:
        """Return the frames that h5py finds; it rejects a file that was not closed and flushed."""
        if self.profile != "jpeg":
            return super().left(path)
        with h5py.File(path, "r") as file:
            return [number_in(row.tobytes()) for row in file[_NAME]]
