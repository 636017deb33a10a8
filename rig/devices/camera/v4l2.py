"""Driver of a local camera, with the numbers and times that V4L2 gives its frames."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt

from rig.core.clock import SECOND_NS, Clock
from rig.core.errors import ConfigError, DeviceLost
from rig.devices.camera.camera import CameraDriver
from rig.devices.camera.jpeg import jpeg_size
from rig.devices.camera.settings import CameraConfig
from rig.devices.camera.v4l2_wire import (
    EXPOSURE_ABSOLUTE,
    EXPOSURE_AUTO,
    EXPOSURE_UNIT,
    GAIN,
    MANUAL,
    Frame,
    Node,
)

Image = npt.NDArray[np.uint8]

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

    def __init__(self, config: CameraConfig, clock: Clock) -> None:
        super().__init__(config, clock)
        self._node: Node | None = None
        self._silent_s = 0.0
        self._sequence: int | None = None
        self._stamps: dict[str, str] = {}

    def open(self, timeout: float) -> None:
        """Open the camera, apply its settings, and check the first frame."""
        self._begin()
        self._silent_s, self._sequence = 0.0, None
        address = self._config.address
        deadline_ns = self._clock.now_ns() + round(timeout * SECOND_NS)
        try:
            self._node = Node(f"/dev/video{address}" if address.isdecimal() else address)
            rate_hz = self._set_up(self._node)
            self._node.start()
            first = self._first_frame(deadline_ns, timeout)
            jpeg = isinstance(first, bytes)
            self._checked_size(*(jpeg_size(first) if jpeg else first.shape[1::-1]))
        except OSError as error:
            self.close()
            raise DeviceLost(
                f"{address}: does not open as a camera ({error.strerror}); check cable and "
                "address, and that no other program uses it"
            ) from error
        except (ConfigError, DeviceLost):
            self.close()
            raise
        self._facts = {
            "device": "camera",
            "address": address,
            "backend": "V4L2",
            "fourcc": self._config.fourcc,
            "rate_hz": rate_hz,
            "width": self._config.width,
            "height": self._config.height,
            "jpeg_bytes_kept": jpeg,
            "numbering": "device",
            **self._stamps,
        }
        self._start_receiving(f"camera-{address}")

    def _release(self) -> None:
        if self._node is not None:
            self._node.close()
            self._node = None

    def _set_up(self, node: Node) -> float:
        c = self._config
        if c.fourcc not in (_JPEG, *_RAW):
            raise ConfigError(
                f"{c.address}: fourcc: found {c.fourcc!r}; allowed: {', '.join((_JPEG, *_RAW))}"
            )
        width, height, fourcc = node.set_format(c.width, c.height, c.fourcc)
        for name, asked, got in (
            ("fourcc", c.fourcc, fourcc),
            ("width", c.width, width),
            ("height", c.height, height),
        ):
            if asked != got:
                raise self._refused(name, asked, got)
        rate_hz = self._set("rate_hz", c.rate_hz, node.set_rate)
        if c.exposure is not None:
            units = round(c.exposure / EXPOSURE_UNIT)
            self._control(node, "auto exposure", EXPOSURE_AUTO, MANUAL)
            self._control(node, "exposure (100 us)", EXPOSURE_ABSOLUTE, units)
        if c.gain is not None:
            self._control(node, "gain", GAIN, round(c.gain))
        return rate_hz

    def _control(self, node: Node, name: str, number: int, asked: int) -> None:
        self._set(name, asked, lambda value: node.set_control(number, round(value)))

    def _set(self, name: str, asked: float, apply: Callable[[float], float]) -> float:
        try:
            got = apply(asked)
        except OSError as error:
            raise self._refused(name, f"{asked:g}", f"error: {error.strerror}") from error
        if abs(got - asked) > 0.01 * abs(asked):
            raise self._refused(name, f"{asked:g}", f"{got:g}")
        return float(got)

    def _refused(self, name: str, asked: object, got: object) -> ConfigError:
        return ConfigError(
            f"{self._config.address}: {name}: asked {asked}, got {got}; "
            "allowed: values the camera offers (v4l2-ctl --list-formats-ext, --list-ctrls)"
        )

    def _receive(self) -> None:
        if self._node is None:
            raise self._not_open()
        try:
            frame = self._node.next_frame(_POLL)
        except OSError as error:
            raise DeviceLost(
                f"{self._config.address}: no frame; unplugged or disconnected "
                f"({error.strerror}); check the camera's cable"
            ) from error
        now_ns = self._clock.now_ns()
        if frame is None:
            self._silent_s += _POLL
            if self._silent_s >= self._config.silence:
                raise DeviceLost(
                    f"{self._config.address}: no frame for {self._config.silence:g} s; check "
                    "the camera's cable and power"
                )
            return
        self._silent_s = 0.0
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

    def _picture(self, frame: Frame) -> bytes | Image | None:
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
