"""Base of the drivers of force sensors on a serial port."""

from __future__ import annotations

import contextlib
import termios
from collections.abc import Iterator
from typing import Any, ClassVar

import serial

from rig.core.clock import Clock
from rig.core.driver import ReceivingDriver
from rig.core.errors import ConfigError, DeviceLost


class SerialDriver(ReceivingDriver):
    """Owner of a serial port; counts what arrived damaged on it.

    Args:
        address: Path of the port.
        clock: Timestamps the samples.
        capacity: Samples kept for a late consumer.
    """

    POWER: ClassVar[str] = "the power"
    """Words for what to check besides the cable."""
    FAREWELL: ClassVar[bytes] = b""
    """Bytes that end a stream, written before the port is closed."""

    def __init__(self, address: str, clock: Clock, capacity: int) -> None:
        super().__init__(address, clock, capacity)
        self._port: serial.Serial | None = None
        self.corrupt = 0
        """Lines or records that were damaged or doubtful."""

    @property
    def dropped(self) -> int:
        """Samples known to be damaged on the line, or not read in time."""
        return self.corrupt + self._inbox.overflowed

    @property
    def rejected(self) -> dict[str, int]:
        """Rejected lines or records, by reason."""
        return {"corrupt": self.corrupt}

    def _connect(self, baud: int, **settings: Any) -> serial.Serial:
        """Open the port for this program alone, with more settings of pyserial; errors pass."""
        self._port = serial.Serial(self._where, baud, exclusive=True, **settings)
        return self._port

    def _open_port(self) -> serial.Serial:
        if self._port is None:
            raise self._not_open()
        return self._port

    def _release(self) -> None:
        if self._port is None:
            return
        if self.FAREWELL:
            with contextlib.suppress(OSError, termios.error):
                self._port.write(self.FAREWELL)
        with contextlib.suppress(OSError, termios.error):
            self._port.close()
        self._port = None

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        """Translate errors of pyserial and of the system."""
        try:
            yield
        except (OSError, termios.error) as error:
            text = " ".join(str(error).split())
            raise DeviceLost(
                f"{self._where}: {text}; check the cable, {self.POWER}, and that the port is "
                "yours (group dialout) and no other program's"
            ) from error
        except ValueError as error:
            raise ConfigError(f"{self._where}: {error}; allowed: a serial port") from error
