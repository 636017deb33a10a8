"""Folder of PNG files, the most common kind of recorder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from benchmarks.recording.frames import number_in_pixels
from benchmarks.recording.stores import Image, Numbers, Opened

_LEVEL = 1


class _Appender:
    def __init__(self, path: Path) -> None:
        path.mkdir()
        self._path = path
        self._count = 0

    def append(self, frame: Image | bytes, t_ns: int) -> None:
        # The channel order does not affect the cost.
        name = str(self._path / f"{self._count:06d}.png")
        if not cv2.imwrite(name, np.asarray(frame), [cv2.IMWRITE_PNG_COMPRESSION, _LEVEL]):
            raise OSError(f"{name}: could not be written")
        self._count += 1

    def close(self) -> None:
        """Do nothing: every file is complete."""


class PngFiles:
    """One file per frame."""

    def create(self, path: Path) -> _Appender:
        """Create a new folder."""
        return _Appender(path)

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

    def repaired(self, path: Path) -> None:
        """Return None: there is no repair."""
        return
