"""Folder of PNG files, the most common kind of recorder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from benchmarks.recording.frames import number_in_pixels
from benchmarks.recording.stores import Appender, Frame, FrameStore, Image, Numbers, Opened


class _Appender(Appender):
    def __init__(self, path: Path, level: int) -> None:
        path.mkdir()
        self._options = [cv2.IMWRITE_PNG_COMPRESSION, level]
        self._path = path
        self._count = 0

    def append(self, frame: Frame, t_ns: int) -> None:
        # The channel order does not affect the cost.
        name = str(self._path / f"{self._count:06d}.png")
        if not cv2.imwrite(name, np.asarray(frame), self._options):
            raise OSError(f"{name}: could not be written")
        self._count += 1


class Store(FrameStore):
    """One file per frame.

    Args:
        profile: Level of compression.
    """

    def __init__(self, profile: str) -> None:
        self._level = int(profile.split()[-1])

    def create(self, path: Path) -> _Appender:
        """Create a new folder."""
        return _Appender(path, self._level)

    @contextmanager
    def reader(self, path: Path) -> Iterator[Opened]:
        """Yield the number of frames and a function that reads them."""
        names = sorted(str(file) for file in path.glob("*.png"))

        def read(first: int, count: int) -> Image:
            return np.stack([np.asarray(cv2.imread(name)) for name in names[first : first + count]])

        yield len(names), read

    def left(self, path: Path) -> Numbers:
        """Return the frames of all files; one that was being written is truncated."""
        found = [cv2.imread(str(file)) for file in sorted(path.glob("*.png"))]
        return [None if image is None else number_in_pixels(np.asarray(image)) for image in found]
