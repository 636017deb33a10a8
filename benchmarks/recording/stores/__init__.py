"""Stores to be compared, one module each; each entry of `STORES` is a row of the page."""

import importlib
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from benchmarks.recording.frames import Frame, Image, number_in

# Number of frames in a store, and a function that decodes n images from a first one.
Opened = tuple[int, Callable[[int, int], Image]]
# Numbers of the frames that a store has, in order; None for one that differs from that written.
Numbers = list[int | None]


class FrameStore:
    """One way to store frames on disk, by its profile; each module has a subclass `Store`."""

    def __init__(self, profile: str) -> None:
        self.profile = profile

    def create(self, path: Path) -> None:
        """Create a new store at `path`, to be written."""
        raise NotImplementedError

    def append(self, frame: Frame, t_ns: int) -> None:
        """Append one frame, pixels or JPEG bytes depending on the store."""
        raise NotImplementedError

    def close(self) -> None:
        """Finish writing; here every append is complete."""

    def finish(self, path: Path) -> None:
        """Do what a store has still to do before it is read, which is not measured."""

    def reader(self, path: Path) -> AbstractContextManager[Opened]:
        """Open the store for reading."""
        raise NotImplementedError

    def left(self, path: Path) -> Numbers:
        """Return the frames that the ordinary reader finds in a store whose writer was killed.

        Raises:
            Exception: Any exception of the reader if the store cannot be opened.
        """
        with self.reader(path) as (count, images):
            return [number_in(images(row, 1)[0]) for row in range(count)]

    def repaired(self, path: Path) -> Numbers | None:
        """Return the same after the store's own repair; None if it has no repair."""
        return None


@dataclass(frozen=True, slots=True)
class Entry:
    """One row of the comparison."""

    title: str
    """Title on the page."""
    module: str
    """Module of this package that defines `Store`."""
    profile: str
    """Argument of `Store`."""
    frames: Literal["pixels", "decoded", "jpeg"]
    """Raw pixels, pixels of a decoded JPEG, or the JPEG itself."""
    checksum: str
    """Checksum over the frame that the store writes, and whether its reader verifies it."""

    @property
    def ours(self) -> bool:
        """True for this recorder, whose closed stores are on the disk; others are flushed."""
        return self.module == "ours"

    def make(self) -> FrameStore:
        """Create the store, and import its library; ImportError if that is not installed."""
        store: FrameStore = importlib.import_module(f"{__name__}.{self.module}").Store(self.profile)
        return store


_CRC = "CRC-32C, verified"
_MCAP = "CRC-32 of a chunk, verified on request"
_ZLIB = "Adler-32 of gzip, verified"
OURS, MCAP = "ours-jpeg", "mcap-jpeg"
STORES = {
    OURS: Entry("**ours**, JPEG", "ours", "jpeg", "jpeg", _CRC),
    "ours-zstd": Entry("**ours**, lossless", "ours", "zstd", "pixels", _CRC),
    "ours-decoded": Entry("**ours**, lossless, of a decoded JPEG", "ours", "zstd", "decoded", _CRC),
    MCAP: Entry("MCAP, JPEG", "mcap", "jpeg", "jpeg", _MCAP),
    "mcap-each-jpeg": Entry("MCAP, JPEG, each written at once", "mcap", "each", "jpeg", _MCAP),
    "mcap-zstd": Entry("MCAP, raw images, zstd", "mcap", "pixels", "pixels", _MCAP),
    "h5py-jpeg": Entry("h5py, JPEG", "hdf5", "jpeg", "jpeg", "none"),
    "h5py-blosc": Entry("h5py, blosc lz4 bitshuffle", "hdf5", "blosc", "pixels", "none"),
    "h5py-gzip": Entry("h5py, gzip 1", "hdf5", "gzip", "pixels", _ZLIB),
    "png": Entry("PNG files (OpenCV)", "png", "1", "pixels", "CRC-32, verified"),
    "zarr-append": Entry("zarr, `append`", "zarr_append", "1", "pixels", "none"),
}
