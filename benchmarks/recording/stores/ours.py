"""Our own recorder: one camera stream of a session."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from benchmarks.recording.frames import HEIGHT, WIDTH, number_in_jpeg, number_in_pixels
from benchmarks.recording.stores import Image, Numbers, Opened
from recorder import Session, SessionWriter, StreamWriter, camera_spec, recover


class _Appender:
    def __init__(self, path: Path, codec: str) -> None:
        spec = camera_spec(60.0, height=HEIGHT, width=WIDTH, codec=codec)
        targets = {"point": np.zeros(0, np.int16)}
        self._session = SessionWriter.create(path, attrs={}, streams=[spec], targets=targets)
        self._writer = StreamWriter.open(self._session.stream_path("camera"))

    def append(self, frame: Image | bytes, t_ns: int) -> None:
        self._writer.append(value=frame, device_t=float("nan"), t_ns=t_ns)

    def close(self) -> None:
        self._writer.close()
        self._session.close()


class Ours:
    """The recorder.

    Args:
        codec: `jpeg` or `zstd`.
    """

    def __init__(self, codec: str) -> None:
        self._codec = codec

    def create(self, path: Path) -> _Appender:
        """Create a new session."""
        return _Appender(path, self._codec)

    @contextmanager
    def reader(self, path: Path) -> Iterator[Opened]:
        """Yield the number of frames and a function that reads them."""
        camera = Session(path).streams["camera"]
        yield len(camera), lambda first, count: camera.images(slice(first, first + count))

    def left(self, path: Path) -> Numbers:
        """Return the sealed frames."""
        camera = Session(path).streams["camera"]
        if self._codec == "jpeg":
            return [number_in_jpeg(camera.jpeg(row) or b"") for row in range(len(camera))]
        return [
            number_in_pixels(camera.images(slice(row, row + 1))[0]) for row in range(len(camera))
        ]

    def repaired(self, path: Path) -> Numbers:
        """Return the frames after `tactile session recover`."""
        recover(path)
        return self.left(path)
