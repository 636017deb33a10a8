"""Driver of a network camera that sends MJPEG over HTTP, by OpenCV.

JPEG bytes sent by the camera are passed on unchanged, without decoding. OpenCV gives neither
numbers nor times of the frames, so frames that never arrive cannot be seen. A camera queues seconds
of frames for a late reader; the reader thread takes each on arrival.
"""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator
from urllib.parse import urlsplit

import cv2

from rig.core.clock import SECOND_NS, Clock
from rig.core.errors import ConfigError, DeviceLost
from rig.devices.camera.camera import CameraDriver
from rig.devices.camera.jpeg import jpeg_size
from rig.devices.camera.settings import CameraConfig

# Opening a stream with OpenCV without long waits or queued frames. Some options can only be passed
# through the environment.

# No frame is held back to estimate the rate, none is queued for decoding.
_OPTIONS = {
    "fflags": "nobuffer",
    "analyzeduration": "0",
    "probesize": "32",
    "fpsprobesize": "0",
    "threads": "1",
}


def open_stream(url: str, *, open_timeout: float, read_timeout: float) -> cv2.VideoCapture:
    """Return a capture of the compressed frames of `url`, which may have failed to open.

    Args:
        url: http://...
        open_timeout: Time limit for the first frame [s].
        read_timeout: Time limit for each later frame, after which `read` returns False [s].
    """
    params = [cv2.CAP_PROP_FORMAT, -1, cv2.CAP_PROP_N_THREADS, 1]
    params += [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, max(round(open_timeout * 1e3), 1)]
    params += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, max(round(read_timeout * 1e3), 1)]
    options = "|".join(f"{name};{value}" for name, value in _OPTIONS.items())
    # A camera on the bench is never behind a proxy, even if the environment sets one.
    host = urlsplit(url).hostname or ""
    with _environment(OPENCV_FFMPEG_CAPTURE_OPTIONS=options, no_proxy=host):
        return cv2.VideoCapture(url, cv2.CAP_FFMPEG, params)


@contextlib.contextmanager
def _environment(**wanted: str) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in wanted}
    os.environ.update(wanted)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


class OpenCvDriver(CameraDriver):
    """Stream of a network camera; see `CameraDriver` for its columns."""

    def __init__(self, config: CameraConfig, clock: Clock) -> None:
        super().__init__(config, clock)
        self._capture: cv2.VideoCapture | None = None
        self._newest: bytes | None = None

    def open(self, timeout: float) -> None:
        """Open the stream and check the first frame."""
        self._begin()
        deadline_ns = self._clock.now_ns() + round(timeout * SECOND_NS)
        self._newest = None
        self._refuse_settings()
        self._probe(timeout)
        left = max((deadline_ns - self._clock.now_ns()) / SECOND_NS, 0.05)
        try:
            self._capture = self._captured(left)
            first = self._first_frame(deadline_ns, timeout)
            width, height = jpeg_size(first)
            self._checked_size(width, height)
            self._facts = {
                "device": "camera",
                "address": self._config.address,
                "backend": self._capture.getBackendName(),
                "fourcc": _fourcc_text(self._capture.get(cv2.CAP_PROP_FOURCC)),
                # OpenCV reports a rate that the camera never sent.
                "rate_hz": None,
                "width": width,
                "height": height,
                "jpeg_bytes_kept": True,
                "device_clock": "none",
                "numbering": "none",
            }
        except (cv2.error, ValueError, DeviceLost) as error:
            self.close()
            if isinstance(error, ConfigError | DeviceLost):
                raise
            raise DeviceLost(f"{self._config.address}: {error}; check the camera") from error
        self._start_receiving(f"camera-{self._config.address}")

    def _release(self) -> None:
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def _refuse_settings(self) -> None:
        if urlsplit(self._config.address).scheme != "http":
            raise ConfigError(
                f"address: {self._config.address!r}; allowed: /dev/videoN, N, http://..."
            )
        for name in ("exposure", "gain"):
            asked = getattr(self._config, name)
            if asked is not None:
                raise ConfigError(
                    f"{self._config.address}: {name}: asked {asked}, got nothing; a network "
                    "camera is set on its own server; allowed: null"
                )

    def _probe(self, timeout: float) -> None:
        url = urlsplit(self._config.address)
        try:
            socket.create_connection((url.hostname or "", url.port or 80), timeout).close()
        except OSError as error:
            raise DeviceLost(
                f"{self._config.address}: {error}; check that the camera's server runs"
            ) from error

    def _captured(self, left: float) -> cv2.VideoCapture:
        address = self._config.address
        capture = open_stream(address, open_timeout=left, read_timeout=self._config.silence)
        if not capture.isOpened():
            capture.release()
            raise DeviceLost(
                f"{address}: does not open as a camera within {left:.1f} s; check cable and "
                "address, and that no other program uses it"
            )
        return capture

    def _receive(self) -> None:
        if self._capture is None:
            raise self._not_open()
        arrived, frame = self._capture.read()
        now_ns = self._clock.now_ns()
        if not arrived:
            raise DeviceLost(
                f"{self._config.address}: no frame; unplugged or disconnected, or silent for "
                f"{self._config.silence:g} s; check its cable and power"
            )
        jpeg = self._checked_jpeg(frame.tobytes())
        if jpeg is None or self._came_before(jpeg):
            return
        self._corrupt_in_a_row = 0
        self._inbox.put({"value": jpeg, "device_t": float("nan")}, now_ns)

    def _came_before(self, jpeg: bytes) -> bool:
        """Return True if the camera sent the previous frame again."""
        if self._config.repeats:
            return False
        same = jpeg == self._newest
        self._newest = jpeg
        self.duplicates += same
        return same


def _fourcc_text(value: float) -> str:
    return int(value).to_bytes(4, "little", signed=False).decode("latin-1")
