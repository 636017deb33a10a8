"""Our own recorder: one camera stream of a session."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from benchmarks.recording.frames import HEIGHT, WIDTH, Frame, number_in
from benchmarks.recording.stores import FrameStore, Numbers, Opened
from recorder import Session, SessionWriter, StreamWriter, camera_spec, recover


class Store(FrameStore):
    """The recorder; its profile is the codec, `jpeg` or `zstd`."""

    def create(self, path: Path) -> None:
        """Create a new session."""
        spec = camera_spec(60.0, height=HEIGHT, width=WIDTH, codec=self.profile)
        targets = {"point": np.zeros(0, np.int16)}
        self._session = SessionWriter.create(path, attrs={}, streams=[spec], targets=targets)
        self._writer = StreamWriter.open(self._session.stream_path("camera"))

    def append(self, frame: Frame, t_ns: int) -> None:
        """Append one frame."""
        self._writer.append(value=frame, device_t=float("nan"), t_ns=t_ns)

    def close(self) -> None:
        """Seal the stream."""
        self._writer.close()
        self._session.close()

    def finish(self, path: Path) -> None:
        """Write the view of synchronised rows and the manifest, as at the end of a collection."""
        with SessionWriter.resume(path) as session:
            session.begin_run({"t0_ns": 0, "utc": "", "boot_id": "benchmark"})
            session.finish("complete", rate_hz=60.0)

    @contextmanager
    def reader(self, path: Path) -> Iterator[Opened]:
        """Yield the number of frames and a function that reads them."""
        camera = Session(path).streams["camera"]
        yield len(camera), lambda first, count: camera.images(slice(first, first + count))

    def left(self, path: Path) -> Numbers:
        """Return the complete frames."""
        camera = Session(path).streams["camera"]
        rows = range(len(camera))
        return [number_in(camera.jpeg(row) or camera.images([row])[0]) for row in rows]

    def repaired(self, path: Path) -> Numbers:
        """Return the frames after `tactile session recover`."""
        recover(path)
        return self.left(path)
