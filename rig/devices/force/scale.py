"""Driver of load cells and scales on a serial port: Fz alone, a few readings a second.

Three languages are spoken. A board with an HX711 prints one number a line, in grams or counts. A
Kern scale answers the command `w`, a Sartorius scale (SBI) the command ESC P, each with a line of
sign, number and unit; both leave the unit out while the reading moves.

A reading lags behind the force by the filter of the scale. Only settled readings are values; while
they move, the value is NaN, and the reading is kept in a column of its own.
"""

import contextlib
import re
import termios
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import serial

from rig.core.clock import SECOND_NS, Clock
from rig.core.driver import ReceivingDriver
from rig.core.errors import ConfigError, DeviceLost
from rig.devices.force.settings import ScaleConfig

# Request for one reading, by protocol; None: the device sends by itself.
REQUESTS: dict[str, bytes | None] = {"hx711": None, "kern": b"w\r\n", "sartorius": b"\x1bP\r\n"}
# Newtons per unit of a scale. It prints the unit only while the reading is stable.
GRAVITY = 9.80665
UNITS = {"mg": 1e-6 * GRAVITY, "g": 1e-3 * GRAVITY, "kg": GRAVITY, "N": 1.0}
# status: the reading has not settled; samples were lost before it.
UNSETTLED, LOST_BEFORE = 1, 2

_LINE = re.compile(r"^(?:(?:[NGT]|Net|Gross)\s+)?([+-]?)\s*(\d+(?:\.\d*)?|\.\d+)\s*([A-Za-z]*)$")
_POLL = 0.05
_CAPACITY = 1000
# More lines in a row than this that are no readings: another device, or wrong settings.
_WRONG_MAX = 20


@dataclass(frozen=True, slots=True)
class Reading:
    """One line of a scale."""

    value: float
    """Number, in the unit if there is one, else in that of the last line with one."""
    unit: str
    """Unit; empty while the reading moves, or if the device prints none."""


def parse(line: str) -> Reading:
    """Return the reading of a line."""
    match = _LINE.match(line.strip())
    if match is None:
        raise ValueError(f"{line!r} is no reading")
    sign, digits, unit = match.groups()
    if unit and unit not in UNITS:
        raise ValueError(f"unit {unit!r}; known: {', '.join(UNITS)}")
    return Reading(-float(digits) if sign == "-" else float(digits), unit)


class ScaleDriver(ReceivingDriver):
    """Stream of a load cell or scale.

    Columns: value (6,) float64 [N, N m] with Fz alone, NaN unless settled; reading float64 [N], Fz
    as read; seq int64 (host's count), status int64 (UNSETTLED, LOST_BEFORE), t_ns. `settled`, which
    is not stored, tells the tare to leave a reading out.
    """

    def __init__(self, config: ScaleConfig, clock: Clock) -> None:
        super().__init__(config.address, clock, _CAPACITY, ("corrupt",))
        self._config = config
        self._port: serial.Serial | None = None
        self._request = REQUESTS[config.protocol]
        self._buffer = b""
        self._unit = ""
        self._recent: deque[tuple[int, float]] = deque()
        self._sequence = -1
        self._heard_ns = self._requested_ns = 0
        self._lost = False

    @property
    def dropped(self) -> int:
        """Lines known to be damaged, or not read in time."""
        return self.rejected["corrupt"] + self._inbox.overflowed

    def _connect(self, timeout: float) -> None:
        config = self._config
        self._buffer, self._unit, self._sequence = b"", "", -1
        self._recent.clear()
        with self._errors():
            self._port = serial.Serial(
                config.address,
                config.baud,
                exclusive=True,
                bytesize=config.bits,
                parity={"none": "N", "odd": "O", "even": "E"}[config.parity],
                timeout=_POLL,
                write_timeout=1.0,
            )
            self._port.reset_input_buffer()
        self._heard_ns, self._requested_ns = self._clock.now_ns(), 0
        self._receive_first(
            f"no reading of a {config.protocol} within {timeout:g} s; check its power, its "
            f"protocol, and its baud rate against {config.baud}"
        )

    def describe(self) -> dict[str, Any]:
        """Return the settings."""
        self._open_port()
        config = self._config
        return {
            "device": "load cell or scale, serial",
            "address": config.address,
            "protocol": config.protocol,
            "baud": config.baud,
            "counts_per_n": config.counts_per_n,
            "direction": config.direction,
            "settle": config.settle,
            "settle_within": config.settle_within,
            "settles": True,
            "device_clock": "none",
            "numbering": "host",
        }

    def _open_port(self) -> serial.Serial:
        if self._port is None:
            raise self._not_open()
        return self._port

    def _release(self) -> None:
        if self._port is not None:
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
                f"{self._where}: {text}; check the cable, the power, and that the port is "
                "yours (group dialout) and no other program's"
            ) from error
        except ValueError as error:
            raise ConfigError(f"{self._where}: {error}; allowed: a serial port") from error

    def _receive(self) -> None:
        port, config = self._open_port(), self._config
        now_ns = self._clock.now_ns()
        with self._errors():
            period_ns = round(SECOND_NS / config.rate_hz)
            if self._request is not None and now_ns - self._requested_ns >= period_ns:
                # Against the last due time, since a read may wait for half a period.
                self._requested_ns = max(self._requested_ns + period_ns, now_ns - period_ns)
                port.write(self._request)
            self._buffer += port.read(max(1, port.in_waiting))
        *lines, self._buffer = re.split(rb"[\r\n]+", self._buffer)
        now_ns = self._clock.now_ns()
        for line in lines:
            if line.strip():
                self._take(line, now_ns)
        if now_ns - self._heard_ns > config.silence * SECOND_NS:
            raise DeviceLost(
                f"{config.address}: no reading for {(now_ns - self._heard_ns) / SECOND_NS:.1f} s; "
                "unplugged, switched off, or asleep?"
            )

    def _take(self, line: bytes, now_ns: int) -> None:
        try:
            reading = parse(line.decode("ascii"))
        except ValueError as error:
            self._lost = True
            self._count_corrupt(
                f"{error}, and so were the {_WRONG_MAX} before; is it a {self._config.protocol}, "
                f"at {self._config.baud} baud?",
                _WRONG_MAX + 1,
            )
            return
        self._corrupt_in_a_row, self._heard_ns = 0, now_ns
        self._unit = reading.unit or self._unit
        force = self._force(reading)
        settled = self._settled(reading, force, now_ns)
        self._sequence += 1
        value = np.full(6, np.nan)
        if settled:
            value[2] = force
        status = (0 if settled else UNSETTLED) | (LOST_BEFORE if self._lost else 0)
        self._lost = False
        sample = {"value": value, "reading": force, "seq": self._sequence, "status": status}
        self._inbox.put({**sample, "settled": settled}, now_ns)

    def _force(self, reading: Reading) -> float:
        """Return Fz [N]: compression of the sensor is negative."""
        config = self._config
        if config.counts_per_n is None:
            force = reading.value * UNITS[self._unit or "g"]
        else:
            force = reading.value / config.counts_per_n
        return -force if config.direction == "down" else force

    def _settled(self, reading: Reading, force: float, now_ns: int) -> bool:
        """Return True if the readings of the last `settle` agree, and the scale says so too."""
        config = self._config
        self._recent.append((now_ns, force))
        horizon_ns = now_ns - round(config.settle * SECOND_NS)
        while len(self._recent) > 1 and self._recent[1][0] <= horizon_ns:
            self._recent.popleft()
        long_enough = self._recent[0][0] <= horizon_ns
        forces = [each for _, each in self._recent]
        agree = max(forces) - min(forces) <= config.settle_within
        stable = config.protocol == "hx711" or bool(reading.unit)
        return long_enough and agree and stable
