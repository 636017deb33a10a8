"""Driver of a foot pedal, a USB keyboard whose reports say which keys are down.

A pedal tells changes only: while it is held, or let go of, nothing comes. That it is still there
shows only when a read fails. So whatever cannot be read counts as let go of.
"""

from __future__ import annotations

import logging

from rig.hid.config import PedalConfig
from rig.hid.device import HidDevice
from rig.hid.reports import parse_keys

logger = logging.getLogger(__name__)

_KEYBOARD = (0x01, 0x06)


class PedalDriver:
    """One pedal.

    Args:
        config: Device and key.
    """

    def __init__(self, config: PedalConfig) -> None:
        self._config = config
        self._device = HidDevice(config.device, "foot pedal", _KEYBOARD)
        self.garbage = 0
        """Reports that were none of a keyboard; each counted as a release."""

    def open(self) -> None:
        """Find and open it.

        Raises:
            DeviceLost: It is not there, or may not be read.
        """
        self._device.open()

    def read(self, timeout: float) -> bool | None:
        """Whether it is down, from the next report; None when none comes within `timeout` [s].

        Raises:
            DeviceLost: Not open, or unplugged.
        """
        report = self._device.read(timeout)
        if not report:
            return None
        try:
            keys = parse_keys(report)
        except ValueError as error:
            self.garbage += 1
            if self.garbage == 1:
                logger.warning("foot pedal: %s; taken for a release", error)
            return False
        return self._config.key in keys if self._config.key else bool(keys)

    def describe(self) -> dict[str, object]:
        """Facts for the session."""
        return {"kind": self._config.KIND, "mode": self._config.mode, "path": self._device.path}

    def close(self) -> None:
        """Let go of it; safe twice."""
        self._device.close()
