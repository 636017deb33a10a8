"""OpenCV camera driver, for a V4L2 camera on USB or a network camera that sends MJPEG over HTTP.

JPEG bytes sent by the camera are passed on unchanged, without decoding. OpenCV reports success for
settings that a camera rejected, so every setting is read back. Both kinds queue frames for a late
reader (V4L2 four, a network camera seconds of them); the reader thread takes each on arrival.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import socket
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np

from rig.core.clock import SECOND_NS, Clock
from rig.core.driver import ReceivingDriver
from rig.core.errors import ConfigError, DeviceLost
from rig.devices.camera.jpeg import is_whole, jpeg_size, with_huffman_tables
from rig.devices.camera.settings import CameraConfig

# Opening cameras with OpenCV without long waits or queued frames.
#
# Some options can only be passed to OpenCV through the environment.

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


def open_node(address: str, *, first_timeout: float) -> cv2.VideoCapture:
    """Return a capture of a V4L2 camera, which may have failed to open.

    Args:
        address: The device file, or its number.
        first_timeout: Time limit for the first frame [s], rounded up to whole seconds; for later
            ones, wait with `cv2.VideoCapture.waitAny`.
    """
    target = int(address) if address.isdecimal() else address
    seconds = max(math.ceil(first_timeout), 1)
    # OpenCV reads it once per process, when it waits for the first frame: so it stays set.
    os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(seconds))
    return cv2.VideoCapture(target, cv2.CAP_V4L2)


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


logger = logging.getLogger(__name__)

_CAPACITY = 120
_CORRUPT_IN_A_ROW = 10
_POLL_NS = SECOND_NS // 10
# V4L2_CID_EXPOSURE_ABSOLUTE counts 100 us.
_EXPOSURE_UNIT = 1e-4
# V4L2_EXPOSURE_MANUAL.
_MANUAL_EXPOSURE = 1


class OpenCvDriver(ReceivingDriver):
    """Stream of one camera.

    Columns: value (JPEG bytes, or (height, width, 3) uint8 RGB from a camera that sends no JPEG),
    device_t float64 [s] (the V4L2 buffer's CLOCK_MONOTONIC time; NaN over HTTP), t_ns.
    """

    def __init__(self, config: CameraConfig, clock: Clock) -> None:
        super().__init__(config.address, clock, _CAPACITY)
        self._config = config
        self._capture: cv2.VideoCapture | None = None
        self._network = "://" in config.address
        self._jpeg = True
        self._facts: dict[str, Any] | None = None
        self._corrupt_in_a_row = 0
        self._idle = 0
        self._newest: bytes | None = None
        self.corrupt = 0
        """Number of frames that were not a complete JPEG file, or of another size."""
        self.duplicates = 0
        """Number of frames sent twice; only the first counts."""

    @property
    def dropped(self) -> int:
        """Frames not read in time; OpenCV gives no sequence numbers to detect other losses."""
        return self._inbox.overflowed

    @property
    def rejected(self) -> dict[str, int]:
        """Rejected frames, by reason."""
        return {"repeated": self.duplicates, "spoilt": self.corrupt}

    def open(self, timeout: float) -> None:
        """Open the camera, apply its settings, and check the first frame.

        Raises:
            DeviceLost: No camera answers within `timeout` [s].
            ConfigError: The camera rejects a setting.
        """
        self._reset()
        deadline_ns = self._clock.now_ns() + round(timeout * SECOND_NS)
        self._corrupt_in_a_row = self._idle = 0
        self._facts = self._newest = None
        if self._network:
            self._refuse_settings()
            self._probe(timeout)
        left = max((deadline_ns - self._clock.now_ns()) / SECOND_NS, 0.05)
        try:
            self._capture = self._captured(left)
            if not self._network:
                self._set_up(self._capture)
            while not (samples := self._inbox.take(0.0)):
                if self._clock.now_ns() >= deadline_ns:
                    raise DeviceLost(
                        f"{self._config.address}: no complete frame within {timeout:g} s; check "
                        "the camera's cable"
                    )
                self._receive()
            self._facts = self._checked_facts(self._capture, samples[0]["value"])
        except (cv2.error, ValueError, DeviceLost) as error:
            self.close()
            if isinstance(error, ConfigError | DeviceLost):
                raise
            raise DeviceLost(f"{self._config.address}: {error}; check the camera") from error
        self._start_receiving(f"camera-{self._config.address}")

    def describe(self) -> dict[str, Any]:
        """Return backend, format, size, the stated frame rate, and if JPEG bytes are kept."""
        if self._facts is None:
            raise self._not_open()
        return dict(self._facts)

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
        address, silence = self._config.address, self._config.silence
        if self._network:
            capture = open_stream(address, open_timeout=left, read_timeout=silence)
        else:
            capture = open_node(address, first_timeout=left)
        if not capture.isOpened():
            capture.release()
            raise DeviceLost(
                f"{address}: does not open as a camera within {left:.1f} s; check cable and "
                "address, and that no other program uses it"
            )
        return capture

    def _set_up(self, capture: cv2.VideoCapture) -> None:
        c = self._config
        fourcc = cv2.VideoWriter.fourcc(*c.fourcc)
        self._set(capture, "fourcc", cv2.CAP_PROP_FOURCC, fourcc)
        self._set(capture, "width", cv2.CAP_PROP_FRAME_WIDTH, c.width)
        self._set(capture, "height", cv2.CAP_PROP_FRAME_HEIGHT, c.height)
        self._set(capture, "rate_hz", cv2.CAP_PROP_FPS, c.rate_hz)
        if c.exposure is not None:
            self._set(capture, "auto exposure", cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL_EXPOSURE)
            units = round(c.exposure / _EXPOSURE_UNIT)
            self._set(capture, "exposure (100 us)", cv2.CAP_PROP_EXPOSURE, units)
        if c.gain is not None:
            self._set(capture, "gain", cv2.CAP_PROP_GAIN, c.gain)
        self._jpeg = c.fourcc == "MJPG"
        if self._jpeg:
            self._set(capture, "convert_rgb", cv2.CAP_PROP_CONVERT_RGB, 0)

    def _set(self, capture: cv2.VideoCapture, name: str, prop: int, asked: float) -> None:
        capture.set(prop, asked)
        got = capture.get(prop)
        if abs(got - asked) > 0.01 * abs(asked):
            texts = [_fourcc_text(v) if name == "fourcc" else f"{v:g}" for v in (asked, got)]
            raise ConfigError(
                f"{self._config.address}: {name}: asked {texts[0]}, got {texts[1]}; "
                "allowed: values the camera offers (v4l2-ctl --list-formats-ext, --list-ctrls)"
            )

    def _checked_facts(self, capture: cv2.VideoCapture, first: Any) -> dict[str, Any]:
        c = self._config
        size = jpeg_size(first) if self._jpeg else (first.shape[1], first.shape[0])
        if size != (c.width, c.height):
            raise ConfigError(
                f"{c.address}: size: asked {c.width}x{c.height}, got {size[0]}x{size[1]}"
            )
        return {
            "device": "camera",
            "address": c.address,
            "backend": capture.getBackendName(),
            "fourcc": _fourcc_text(capture.get(cv2.CAP_PROP_FOURCC)),
            # Over HTTP, OpenCV reports a rate that the camera never sent.
            "rate_hz": None if self._network else float(capture.get(cv2.CAP_PROP_FPS)),
            "width": size[0],
            "height": size[1],
            "jpeg_bytes_kept": self._jpeg,
            "device_clock": "none" if self._network else "monotonic",
        }

    def _receive(self) -> None:
        capture = self._capture
        if capture is None:
            raise self._not_open()
        frame = self._next_frame(capture)
        now_ns = self._clock.now_ns()
        if frame is None:
            return
        device_t = float("nan")
        if not self._network:
            device_t = capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
        value: Any
        if self._jpeg:
            value = frame.tobytes()
            if not is_whole(value):
                self._corrupt("torn frames")
                return
            size = jpeg_size(value)
            if self._facts is not None and size != (self._config.width, self._config.height):
                self._corrupt(f"frames of {size[0]}x{size[1]} px")
                return
            if self._came_before(value):
                return
            value = with_huffman_tables(value)
        else:
            value = np.ascontiguousarray(frame[:, :, ::-1])
        self._corrupt_in_a_row = 0
        self._inbox.put({"value": value, "device_t": device_t}, now_ns)

    def _next_frame(self, capture: cv2.VideoCapture) -> Any:
        lost = f"{self._config.address}: no frame; unplugged or disconnected"
        if not self._network:
            # V4L2's own wait in `read` lasts 10 s and cannot be changed.
            try:
                ready, _ = cv2.VideoCapture.waitAny([capture], timeoutNs=_POLL_NS)
            except cv2.error as error:
                raise DeviceLost(f"{lost}; check the camera's cable") from error
            self._idle = 0 if ready else self._idle + 1
            if self._idle * _POLL_NS >= self._config.silence * SECOND_NS:
                raise DeviceLost(
                    f"{self._config.address}: no frame for {self._config.silence:g} s; check "
                    "the camera's cable and power"
                )
            if not ready:
                return None
        arrived, frame = capture.read()
        if not arrived:
            raise DeviceLost(
                f"{lost}, or silent for {self._config.silence:g} s; check its cable and power"
            )
        return frame

    def _came_before(self, jpeg: bytes) -> bool:
        """Return True if a network camera sent the previous frame again; V4L2 does not."""
        if not self._network or self._config.repeats:
            return False
        same = jpeg == self._newest
        self._newest = jpeg
        self.duplicates += same
        return same

    def _corrupt(self, what: str) -> None:
        self.corrupt += 1
        self._corrupt_in_a_row += 1
        if self._corrupt_in_a_row >= _CORRUPT_IN_A_ROW:
            raise DeviceLost(
                f"{self._config.address}: {_CORRUPT_IN_A_ROW} {what} in a row; "
                "check the cable, and that no other camera shares its USB bus"
            )


def _fourcc_text(value: float) -> str:
    return int(value).to_bytes(4, "little", signed=False).decode("latin-1")
