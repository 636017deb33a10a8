"""Folder of PNG files, the most common kind of recorder."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from benchmarks.recording.frames import Frame, Image, number_in
from benchmarks.recording.stores import FrameStore, Numbers, Opened


class Store(FrameStore):
    """One file per frame; its profile is the level of compression."""

    def create(self, path: Path) -> None:
        """Create a new folder."""
        path.mkdir()
        self._path, self._count = path, 0

    def append(self, frame: Frame, t_ns: int) -> None:
        """Write one file; the channel order does not affect the cost."""
        name = str(self._path / f"{self._count:06d}.png")
        if not cv2.imwrite(
            name, np.asarray(frame), [cv2.IMWRITE_PNG_COMPRESSION, int(self.profile)]
        ):
            raise OSError(f"{name}: could not be written")
        self._count += 1

    @contextmanager
    def reader(self, path: Path) -> Iterator[Opened]:
        """Yield the number of frames and a function that reads them."""
        names = sorted(str(file) for file in path.glob("*.png"))

        def read(first: int, count: int) -> Image:
            return np.stack([np.asarray(cv2.imread(name)) for name in names[first : first + count]])

        yield len(names), read

    def left(self, path: Path) -> Numbers:
        """Return the frames of all files; one that was being written is truncated."""
        pixels = [cv2.imread(str(file)) for file in sorted(path.glob("*.png"))]
        return [None if image is None else number_in(np.asarray(image)) for image in pixels]
