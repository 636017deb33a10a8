"""Driver of a camera of either kind: sorts out frames that are torn, resized or repeated."""

from __future__ import annotations

from typing import Any

from rig.core.clock import Clock
from rig.core.driver import ReceivingDriver
from rig.core.errors import ConfigError, DeviceLost
from rig.devices.camera.jpeg import is_whole, jpeg_size, with_huffman_tables
from rig.devices.camera.settings import CameraConfig

_CAPACITY = 120
_CORRUPT_IN_A_ROW = 10


class CameraDriver(ReceivingDriver):
    """Stream of one camera.

    Columns: value (JPEG bytes, or (height, width, 3) uint8 RGB from a camera that sends no JPEG),
    device_t float64 [s] (the driver's CLOCK_MONOTONIC time; NaN without one), seq int64 (the
    driver's number of the frame; only if it numbers them), t_ns.
    """

    def __init__(self, config: CameraConfig, clock: Clock) -> None:
        super().__init__(config.address, clock, _CAPACITY)
        self._config = config
        self._facts: dict[str, Any] | None = None
        self._corrupt_in_a_row = 0
        self.corrupt = 0
        """Number of frames that were not a complete JPEG file, or of another size."""
        self.duplicates = 0
        """Number of frames sent twice; only the first counts."""

    @property
    def rejected(self) -> dict[str, int]:
        """Rejected frames, by reason."""
        return {"repeated": self.duplicates, "corrupt": self.corrupt}

    def describe(self) -> dict[str, Any]:
        """Return backend, format, size, the stated frame rate, and if JPEG bytes are kept."""
        if self._facts is None:
            raise self._not_open()
        return dict(self._facts)

    def _begin(self) -> None:
        self._reset()
        self._corrupt_in_a_row = 0
        self._facts = None

    def _first_frame(self, deadline_ns: int, timeout: float) -> Any:
        """Receive until a frame is complete, and return it."""
        while not (samples := self._inbox.take(0.0)):
            if self._clock.now_ns() >= deadline_ns:
                raise DeviceLost(
                    f"{self._config.address}: no complete frame within {timeout:g} s; check "
                    "the camera's cable"
                )
            self._receive()
        return samples[0]["value"]

    def _checked_size(self, width: int, height: int) -> None:
        c = self._config
        if (width, height) != (c.width, c.height):
            raise ConfigError(
                f"{c.address}: size: asked {c.width}x{c.height}, got {width}x{height}"
            )

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
        self.corrupt += 1
        self._corrupt_in_a_row += 1
        if self._corrupt_in_a_row >= _CORRUPT_IN_A_ROW:
            raise DeviceLost(
                f"{self._config.address}: {_CORRUPT_IN_A_ROW} {what} in a row; "
                "check the cable, and that no other camera shares its USB bus"
            )
