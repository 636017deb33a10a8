"""Drivers of cameras: on a V4L2 node, and of MJPEG over HTTP.

JPEG bytes sent by the camera are passed on unchanged, without decoding; frames that are torn,
resized or repeated are left out. V4L2 gives numbers and times of the frames, HTTP neither, so that
of a network camera a frame that never arrives cannot be seen. A camera queues seconds of frames for
a late reader; the reader thread takes each on arrival.
"""

import socket
from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np
import numpy.typing as npt

from recorder.processes import environment
from rig.core.clock import Clock
from rig.core.driver import CORRUPT_IN_A_ROW, ReceivingDriver
from rig.core.errors import ConfigError, DeviceLost
from rig.devices.camera import v4l2_wire as wire
from rig.devices.camera.jpeg import is_whole, jpeg_size, with_huffman_tables
from rig.devices.camera.settings import MjpegConfig, V4l2Config

Image = npt.NDArray[np.uint8]

_CAPACITY = 120


class CameraDriver(ReceivingDriver):
    """Stream of one camera.

    Columns: value (JPEG bytes, or (height, width, 3) uint8 RGB from a camera that sends no JPEG),
    device_t float64 [s] (the driver's CLOCK_MONOTONIC time; NaN without one), seq int64 (the
    driver's number of the frame; only if it numbers them), t_ns.
    """

    def __init__(self, config: MjpegConfig | V4l2Config, clock: Clock) -> None:
        super().__init__(config.address, clock, _CAPACITY, ("repeated", "corrupt"))
        self._config = config
        self._facts: dict[str, Any] | None = None

    def describe(self) -> dict[str, Any]:
        """Return backend, format, size, the stated frame rate, and if JPEG bytes are kept."""
        if self._facts is None:
            raise self._not_open()
        return dict(self._facts)

    def _checked_frame(self, timeout: float) -> Any:
        """Receive until a frame is complete, and return it if it is of the right size."""
        c = self._config
        self._facts = None
        self._receive_first(f"no complete frame within {timeout:g} s; check the camera's cable")
        frame = self._inbox.take(0.0)[0]["value"]
        width, height = jpeg_size(frame) if isinstance(frame, bytes) else frame.shape[1::-1]
        if (width, height) != (c.width, c.height):
            raise ConfigError(
                f"{self._where}: size: asked {c.width}x{c.height}, got {width}x{height}"
            )
        return frame

    def _checked_jpeg(self, jpeg: bytes) -> bytes | None:
        """Return a complete JPEG file with its tables; None, and count it, if it is not one."""
        if not is_whole(jpeg):
            self._reject("torn frames")
            return None
        size = jpeg_size(jpeg)
        if self._facts is not None and size != (self._config.width, self._config.height):
            self._reject(f"frames of {size[0]}x{size[1]} px")
            return None
        return with_huffman_tables(jpeg)

    def _reject(self, what: str) -> None:
        self._count_corrupt(
            f"{CORRUPT_IN_A_ROW} {what} in a row; check the cable, and that no other camera "
            "shares its USB bus"
        )


_POLL = 0.1
_JPEG = "MJPG"
# Conversion to RGB, and bytes per pixel, of the formats that are not compressed.
_RAW: dict[str, tuple[int | None, int]] = {
    "YUYV": (cv2.COLOR_YUV2RGB_YUYV, 2),
    "UYVY": (cv2.COLOR_YUV2RGB_UYVY, 2),
    "BGR3": (cv2.COLOR_BGR2RGB, 3),
    "RGB3": (None, 3),
    "GREY": (cv2.COLOR_GRAY2RGB, 1),
}


class V4l2Driver(CameraDriver):
    """Stream of a camera on a V4L2 node; see `CameraDriver` for its columns.

    The driver numbers every frame, also those that it had no buffer for: a gap is a lost frame.
    """

    def __init__(self, config: V4l2Config, clock: Clock) -> None:
        super().__init__(config, clock)
        self._config: V4l2Config = config
        self._node: wire.Node | None = None
        self._sequence: int | None = None
        self._stamps: dict[str, str] = {}

    def _connect(self, timeout: float) -> None:
        self._sequence = None
        address = self._where
        try:
            self._node = wire.Node(f"/dev/video{address}" if address.isdecimal() else address)
            rate_hz = self._set_up(self._node)
            self._node.start()
            frame = self._checked_frame(timeout)
        except OSError as error:
            raise DeviceLost(
                f"{address}: does not open as a camera ({error.strerror}); check cable and "
                "address, and that no other program uses it"
            ) from error
        self._facts = {
            "device": "camera",
            "address": address,
            "backend": "V4L2",
            "fourcc": self._config.fourcc,
            "rate_hz": rate_hz,
            "width": self._config.width,
            "height": self._config.height,
            "jpeg_bytes_kept": isinstance(frame, bytes),
            "numbering": "device",
            "automatic": self._node.automatic(),
            **self._stamps,
        }

    def _release(self) -> None:
        if self._node is not None:
            self._node.close()
            self._node = None

    def _set_up(self, node: wire.Node) -> float:
        c = self._config
        if c.fourcc not in (_JPEG, *_RAW):
            raise ConfigError(
                f"{c.address}: fourcc: found {c.fourcc!r}; allowed: {', '.join((_JPEG, *_RAW))}"
            )
        width, height, fourcc = node.set_format(c.width, c.height, c.fourcc)
        for name, requested, got in (
            ("fourcc", c.fourcc, fourcc),
            ("width", c.width, width),
            ("height", c.height, height),
        ):
            if requested != got:
                raise self._refused(name, requested, got)
        rate_hz = self._set("rate_hz", c.rate_hz, node.set_rate)
        if c.exposure is not None:
            units = round(c.exposure / wire.EXPOSURE_UNIT)
            self._control(node, "auto exposure", wire.EXPOSURE_AUTO, wire.MANUAL)
            self._control(node, "exposure (100 us)", wire.EXPOSURE_ABSOLUTE, units)
        if c.gain is not None:
            self._control(node, "gain", wire.GAIN, round(c.gain))
        return rate_hz

    def _control(self, node: wire.Node, name: str, number: int, requested: int) -> None:
        self._set(name, requested, lambda value: node.set_control(number, round(value)))

    def _set(self, name: str, requested: float, apply: Callable[[float], float]) -> float:
        try:
            got = apply(requested)
        except OSError as error:
            raise self._refused(name, f"{requested:g}", f"error: {error.strerror}") from error
        if abs(got - requested) > 0.01 * abs(requested):
            raise self._refused(name, f"{requested:g}", f"{got:g}")
        return float(got)

    def _refused(self, name: str, requested: object, got: object) -> ConfigError:
        return ConfigError(
            f"{self._where}: {name}: asked {requested}, got {got}; "
            "allowed: values the camera offers (v4l2-ctl --list-formats-ext, --list-ctrls)"
        )

    def _receive(self) -> None:
        if self._node is None:
            raise self._not_open()
        try:
            frame = self._node.next_frame(_POLL)
        except OSError as error:
            raise DeviceLost(
                f"{self._where}: no frame; unplugged or disconnected "
                f"({error.strerror}); check the camera's cable"
            ) from error
        now_ns = self._clock.now_ns()
        if frame is None:
            self._count_wait(
                _POLL,
                self._config.silence,
                f"no frame for {self._config.silence:g} s; check the camera's cable and power",
            )
            return
        self._waits = 0
        if self._facts is None:
            self._stamps = {
                "device_clock": "none" if np.isnan(frame.time) else "monotonic",
                "stamp": "start" if frame.at_start else "end",
            }
        seq = self._numbered(frame.sequence)
        value = self._picture(frame)
        if value is not None:
            self._corrupt_in_a_row = 0
            self._inbox.put({"value": value, "device_t": frame.time, "seq": seq}, now_ns)

    def _numbered(self, sequence: int) -> int:
        """Return the number of the frame without wrapping at 2**32, and count the gap before it."""
        if self._sequence is None:
            self._sequence = sequence
            return sequence
        step = (sequence - self._sequence) & 0xFFFFFFFF
        self._gaps += max(step - 1, 0)
        self._sequence += step
        return self._sequence

    def _picture(self, frame: wire.Frame) -> bytes | Image | None:
        c = self._config
        if frame.damaged:
            self._reject("damaged frames")
            return None
        if c.fourcc == _JPEG:
            return self._checked_jpeg(frame.data)
        conversion, depth = _RAW[c.fourcc]
        # A driver may pad the rows.
        rows = np.frombuffer(frame.data, np.uint8)
        if rows.size < c.width * c.height * depth or rows.size % c.height:
            self._reject("cut frames")
            return None
        pixels = rows.reshape(c.height, -1)[:, : c.width * depth]
        pixels = np.ascontiguousarray(pixels).reshape(c.height, c.width, depth)
        if conversion is None:
            return pixels
        return np.asarray(cv2.cvtColor(pixels, conversion), np.uint8)


# No frame is held back to estimate the rate, none is queued for decoding. OpenCV takes these
# options from the environment alone.
_OPTIONS = {
    "fflags": "nobuffer",
    "analyzeduration": "0",
    "probesize": "32",
    "fpsprobesize": "0",
    "threads": "1",
}


class MjpegDriver(CameraDriver):
    """Stream of MJPEG over HTTP, by OpenCV's FFmpeg; see `CameraDriver` for its columns."""

    def __init__(self, config: MjpegConfig, clock: Clock) -> None:
        super().__init__(config, clock)
        self._config: MjpegConfig = config
        self._capture: cv2.VideoCapture | None = None
        self._newest: bytes | None = None

    def _connect(self, timeout: float) -> None:
        self._newest = None
        self._probe(timeout)
        try:
            self._capture = self._captured(self._left())
            self._checked_frame(timeout)
            code = int(self._capture.get(cv2.CAP_PROP_FOURCC))
            backend = self._capture.getBackendName()
        except cv2.error as error:
            raise DeviceLost(f"{self._where}: {error}; check the camera") from error
        self._facts = {
            "device": "camera",
            "address": self._where,
            "backend": backend,
            "fourcc": code.to_bytes(4, "little").decode("latin-1"),
            # OpenCV reports a rate that the camera never sent.
            "rate_hz": None,
            "width": self._config.width,
            "height": self._config.height,
            "jpeg_bytes_kept": True,
            "device_clock": "none",
            "numbering": "none",
        }

    def _release(self) -> None:
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def _probe(self, timeout: float) -> None:
        url = urlsplit(self._config.address)
        try:
            socket.create_connection((url.hostname or "", url.port or 80), timeout).close()
        except OSError as error:
            raise DeviceLost(
                f"{self._where}: {error}; check that the camera's server runs"
            ) from error

    def _captured(self, left: float) -> cv2.VideoCapture:
        """Return a capture of the compressed frames, open within `left` [s]."""
        params = [cv2.CAP_PROP_FORMAT, -1, cv2.CAP_PROP_N_THREADS, 1]
        params += [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, max(round(left * 1e3), 1)]
        params += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, max(round(self._config.silence * 1e3), 1)]
        options = "|".join(f"{name};{value}" for name, value in _OPTIONS.items())
        # A camera on the bench is never behind a proxy, even if the environment sets one.
        host = urlsplit(self._where).hostname or ""
        with environment(OPENCV_FFMPEG_CAPTURE_OPTIONS=options, no_proxy=host):
            capture = cv2.VideoCapture(self._where, cv2.CAP_FFMPEG, params)
        if not capture.isOpened():
            capture.release()
            raise DeviceLost(
                f"{self._where}: does not open as a camera within {left:.1f} s; check cable and "
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
                f"{self._where}: no frame; unplugged or disconnected, or silent for "
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
        self.rejected["repeated"] += same
        return same
