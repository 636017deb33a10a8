"""Stores to be compared, one module each; each entry of `STORES` is a row of the page."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from benchmarks.recording.frames import number_in_jpeg, number_in_pixels

Image = NDArray[np.uint8]
# A frame as it is stored: pixels (480, 640, 3), or a JPEG.
Frame = Image | bytes
# Number of frames in a store, and a function that decodes n images from a first one.
Opened = tuple[int, Callable[[int, int], Image]]
# Numbers of the frames found, in order; None for a frame that differs from the one written.
Numbers = list[int | None]


class Appender:
    """A store being written."""

    def append(self, frame: Frame, t_ns: int) -> None:
        """Append one frame, pixels or JPEG bytes depending on the store."""
        raise NotImplementedError

    def close(self) -> None:
        """Finish the store; here every append is complete."""


class FrameStore:
    """One way to store frames on disk; each module has a subclass `Store`."""

    def create(self, path: Path) -> Appender:
        """Create a new store at `path`."""
        raise NotImplementedError

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
            return [number_in_pixels(images(row, 1)[0]) for row in range(count)]

    def repaired(self, path: Path) -> Numbers | None:
        """Return the same after the store's own repair; None if it has no repair."""
        return None


def number_in(frame: Frame) -> int | None:
    """Return the number of a stored frame, or None if it is not a complete frame."""
    return number_in_jpeg(frame) if isinstance(frame, bytes) else number_in_pixels(frame)


@dataclass(frozen=True, slots=True)
class Entry:
    """One row of the comparison."""

    key: str
    """Short name, for the command line of the measuring process."""
    title: str
    """Title on the page."""
    module: str
    """Module of this package that defines `Store`."""
    profile: str
    """Argument of `Store`: how the frames are stored."""
    takes: Literal["pixels", "decoded", "jpeg"]
    """Raw pixels, pixels of a decoded JPEG, or the JPEG itself."""
    checksum: str
    """Checksum over the frame that the store writes, and whether its reader verifies it."""

    @property
    def ours(self) -> bool:
        """True for this recorder, whose closed stores are on the disk; others are flushed."""
        return self.module == "ours"

    def make(self) -> FrameStore:
        """Create the store; its library is imported here.

        Raises:
            ImportError: The library is not installed.
        """
        module = importlib.import_module(f"{__name__}.{self.module}")
        store: FrameStore = module.Store(self.profile)
        return store


_CRC = "CRC-32C, verified"
_MCAP = "CRC-32 of a chunk, verified on request"
_ZLIB = "Adler-32 of gzip, verified"
OURS, MCAP = "ours-jpeg", "mcap-jpeg"
STORES = (
    Entry(OURS, "**ours**, JPEG", "ours", "jpeg", "jpeg", _CRC),
    Entry("ours-zstd", "**ours**, lossless", "ours", "zstd", "pixels", _CRC),
    Entry("ours-decoded", "**ours**, lossless, of a decoded JPEG", "ours", "zstd", "decoded", _CRC),
    Entry(MCAP, "MCAP, JPEG", "mcap", "jpeg", "jpeg", _MCAP),
    Entry("mcap-each-jpeg", "MCAP, JPEG, each written at once", "mcap", "each", "jpeg", _MCAP),
    Entry("mcap-zstd", "MCAP, raw images, zstd", "mcap", "pixels", "pixels", _MCAP),
    Entry("h5py-jpeg", "h5py, JPEG", "hdf5", "jpeg", "jpeg", "none"),
    Entry("h5py-blosc", "h5py, blosc lz4 bitshuffle", "hdf5", "blosc", "pixels", "none"),
    Entry("h5py-gzip", "h5py, gzip 1", "hdf5", "gzip", "pixels", _ZLIB),
    Entry("png", "PNG files (OpenCV)", "png", "level 1", "pixels", "CRC-32, verified"),
    Entry("zarr-append", "zarr, `append`", "zarr_append", "zstd 1", "pixels", "none"),
)


def entry(key: str) -> Entry:
    """Return the entry with that key.

    Raises:
        KeyError: No such entry.
    """
    return {one.key: one for one in STORES}[key]
