"""Stores to be compared, one module each; each entry of `STORES` is a row of the page."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
# Number of frames in a store, and a function that reads n images from a first one.
Opened = tuple[int, Callable[[int, int], Image]]
# Numbers of the frames found, in order; None for a frame that differs from the one written.
Numbers = list[int | None]


class Appender(Protocol):
    """A store being written."""

    def append(self, frame: Image | bytes, t_ns: int) -> None:
        """Append one frame, pixels (480, 640, 3) or JPEG bytes depending on the store."""

    def close(self) -> None:
        """Finish the store."""


class Store(Protocol):
    """One way to store frames on disk."""

    def create(self, path: Path) -> Appender:
        """Create a new store at `path`."""

    def reader(self, path: Path) -> AbstractContextManager[Opened]:
        """Open the store for reading."""

    def left(self, path: Path) -> Numbers:
        """Return the frames that the ordinary reader finds in a store whose writer was killed.

        Raises:
            Exception: Any exception of the reader if the store cannot be opened.
        """

    def repaired(self, path: Path) -> Numbers | None:
        """Return the same after the store's own repair; None if it has no repair."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One row of the comparison."""

    key: str
    """Short name, for the command line of the measuring process."""
    title: str
    """Title on the page."""
    module: str
    """Module of this package that defines the class."""
    store: str
    """Name of the class; called with `options`."""
    takes: Literal["pixels", "decoded", "jpeg"]
    """Raw pixels, pixels of a decoded JPEG, or the JPEG itself."""
    checksum: str
    """Checksum over the frame that the store writes, and whether its reader verifies it."""
    needs: tuple[str, ...] = ()
    """Required libraries of the extra `bench`."""
    options: tuple[str, ...] = ()
    """Arguments of the class."""
    foreign: bool = False
    """True if it runs in the interpreter given by LEROBOT_PYTHON."""
    lossy: bool = False
    """True if pixels are lossy, so that frame numbers cannot be read back."""

    def make(self) -> Store:
        """Create the store; its library is imported here.

        Raises:
            ImportError: The library is not installed.
        """
        module = importlib.import_module(f"{__name__}.{self.module}")
        store: Store = getattr(module, self.store)(*self.options)
        return store


_OURS = "CRC-32C, verified"
_MCAP = "CRC-32 of a chunk, verified on request"
STORES = (
    Entry("ours-jpeg", "**ours**, camera's JPEG", "ours", "Ours", "jpeg", _OURS, options=("jpeg",)),
    Entry(
        "ours-zstd", "**ours**, lossless (zstd)", "ours", "Ours", "pixels", _OURS, options=("zstd",)
    ),
    Entry(
        "ours-decoded",
        "**ours**, lossless, of a decoded JPEG",
        "ours",
        "Ours",
        "decoded",
        _OURS,
        options=("zstd",),
    ),
    Entry(
        "h5py-blosc",
        "h5py, chunk a frame, blosc lz4 bitshuffle",
        "hdf5",
        "Hdf5",
        "pixels",
        "none",
        ("h5py", "hdf5plugin"),
        ("blosc",),
    ),
    Entry(
        "h5py-gzip",
        "h5py, chunk a frame, gzip 1",
        "hdf5",
        "Hdf5",
        "pixels",
        "Adler-32 of gzip, verified",
        ("h5py", "hdf5plugin"),
        ("gzip",),
    ),
    Entry(
        "h5py-jpeg",
        "h5py, camera's JPEG (vlen bytes)",
        "hdf5",
        "Hdf5",
        "jpeg",
        "none",
        ("h5py", "hdf5plugin"),
        ("jpeg",),
    ),
    Entry(
        "png",
        "PNG files (OpenCV, level 1)",
        "png",
        "PngFiles",
        "pixels",
        "CRC-32, verified",
        ("cv2",),
    ),
    Entry(
        "mcap-zstd",
        "MCAP, raw images, zstd",
        "mcap",
        "Mcap",
        "pixels",
        _MCAP,
        ("mcap",),
        ("pixels",),
    ),
    Entry("mcap-jpeg", "MCAP, camera's JPEG", "mcap", "Mcap", "jpeg", _MCAP, ("mcap",), ("jpeg",)),
    Entry(
        "mcap-each-jpeg",
        "MCAP, camera's JPEG, each written at once",
        "mcap",
        "Mcap",
        "jpeg",
        _MCAP,
        ("mcap",),
        ("jpeg", "at-once"),
    ),
    Entry(
        "zarr-append",
        "zarr, `append` a frame, zstd 1",
        "zarr_append",
        "ZarrAppend",
        "pixels",
        "none",
    ),
    Entry(
        "lerobot-image",
        "LeRobot, PNG in parquet",
        "lerobot",
        "LeRobot",
        "pixels",
        "CRC-32 of PNG, verified",
        ("lerobot",),
        ("image",),
        foreign=True,
    ),
    Entry(
        "lerobot-video",
        "LeRobot, AV1 video (lossy)",
        "lerobot",
        "LeRobot",
        "pixels",
        "none",
        ("lerobot",),
        ("video",),
        foreign=True,
        lossy=True,
    ),
)


def entry(key: str) -> Entry:
    """Return the entry with that key.

    Raises:
        KeyError: No such entry.
    """
    return {one.key: one for one in STORES}[key]
