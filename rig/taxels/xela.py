"""XELA uSkin driver: the JSON messages of `xela_server`, by WebSocket.

The first message is `{"message": "Welcome"}`; then, for every scan,

    1.7  {"message": 786, "time": 1619157045.62, "sensors": 1,
          "1": {"data": "FA00,FB00,...", "sensor": "1", "taxels": 16, "model": "XR1944",
                "calibrated": null}}
    1.8  the same with "sendtime" and "type" on top and "time", "ups", "temp" in each sensor

`message` counts scans. `data` holds X, Y, Z of each taxel, row by row from the top left, as
hexadecimal uint16, perhaps without leading zeros. `calibrated` is null, or as many numbers in N,
whole ones without a point; it is not read. The rate is nowhere settable, and varies.

device_t is the sensor's own `time` (when it was scanned) where the layout has one, else the
message's `time`, NaN where neither is a number. `sendtime` (when the server sent) is never taken.
"""

from __future__ import annotations

import contextlib
import json
import logging
import re
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from websockets.exceptions import ConnectionClosed, InvalidURI, WebSocketException
from websockets.sync.client import ClientConnection, connect

from rig.clock import SECOND_NS, Clock
from rig.driver import Inbox, Receiver
from rig.errors import ConfigError, DeviceLost
from rig.taxels.config import XelaConfig

logger = logging.getLogger(__name__)

_POLL = 0.1
_CORRUPT_IN_A_ROW = 10
_CAPACITY = 10_000
_HEX = re.compile(r"0{0,4}[0-9A-Fa-f]{1,4}")
_OLD_SUITE = (
    "a suite before 1.7 (0.2 and others) sends another layout, which the rig does not read; "
    "update the XELA suite"
)
_SOCKET_IO = f"that is Socket.IO, not plain WebSocket; {_OLD_SUITE}"
_LATE = 50
_LATE_IN_A_ROW = 10
# A scan this little behind the newest is late; more, or so often in a row: the server counts anew.
_JUMP, _JUMPED = 8192, 0.5
# Counts, and the part of all values: no touch moves so many by an eighth of the range in one scan
# (the largest step of any value in three public recordings of grasps, 779 scans, is 527 counts).


class Scan(NamedTuple):
    """One message about one sensor."""

    message: int
    """The server's count of scans."""
    device_t: float
    """The server's time of the scan, seconds since 1970; NaN when it gives none."""
    counts: npt.NDArray[np.int32]
    """Raw counts, (taxels, 3)."""
    facts: dict[str, Any]
    """What else the sensor's part says, without the data."""


def parse(text: str | bytes, sensor: str, taxels: int) -> Scan | None:
    """The scan a message tells of; None for the welcome.

    Args:
        text: The message.
        sensor: The sensor's key in it.
        taxels: How many it must have.

    Raises:
        ValueError: It is no message of a server with such a sensor.
    """
    if text[:1] in ("4", "0", b"4", b"0"):
        raise ValueError(f"{text[:24]!r}: {_SOCKET_IO}")
    message = json.loads(text)
    if not isinstance(message, dict):
        raise ValueError(f"no JSON object: {text[:40]!r}")
    number = message.get("message")
    if isinstance(number, str) and number.startswith("Welcome"):
        return None
    if not isinstance(number, int) or isinstance(number, bool):
        old = f"; {_OLD_SUITE}" if number is None and _is_old(message) else ""
        raise ValueError(f"message: {number!r}; expected a count{old}")
    part = message.get(sensor)
    if not isinstance(part, dict):
        found = [key for key, value in message.items() if isinstance(value, dict)]
        raise ValueError(f"no sensor {sensor!r}; the server has {found}")
    return Scan(
        message=number,
        device_t=_time(part, message),
        counts=np.array(_values(part, taxels), np.int32).reshape(taxels, 3),
        facts={key: value for key, value in part.items() if key != "data"},
    )


def _is_old(message: dict[str, Any]) -> bool:
    return any(isinstance(value, list) for value in message.values()) or "xyz" in message


def _values(part: dict[str, Any], taxels: int) -> list[int]:
    data = part.get("data")
    if not isinstance(data, str):
        raise ValueError(f"data: {type(data).__name__}; expected 3 x {taxels} values as text")
    words = data.split(",")
    if len(words) != 3 * taxels:
        model = part.get("model")
        raise ValueError(
            f"data: {len(words)} values; expected 3 x {taxels} taxels"
            + (f"; it is a {model}: is it the sensor of the bench file?" if model else "")
        )
    # Not int(word, 16) alone, which takes a sign, an underscore, 0x and blanks.
    bad = [word for word in words if not _HEX.fullmatch(word)]
    if bad:
        raise ValueError(f"data: {bad[0][:16]!r}; expected hexadecimal, nothing outside 0..FFFF")
    return [int(word, 16) for word in words]


def _time(part: dict[str, Any], message: dict[str, Any]) -> float:
    for found in (part.get("time"), message.get("time")):
        if isinstance(found, int | float) and not isinstance(found, bool):
            return float(found)
    return float("nan")


class XelaDriver:
    """The stream of one uSkin sensor.

    Columns: value (taxels, 3) int32 raw counts, device_t float64 [s], seq int64, t_ns.
    """

    def __init__(self, config: XelaConfig, clock: Clock) -> None:
        self._config = config
        self._clock = clock
        self._exits = contextlib.ExitStack()
        self._connection: ClientConnection | None = None
        self._receiver: Receiver | None = None
        self._inbox = Inbox(clock, _CAPACITY)
        self._first: Scan | None = None
        self._sequence: int | None = None
        self._restarted_by = 0
        self._idle = 0
        self._corrupt_in_a_row = 0
        self._late_in_a_row = 0
        self._newest: Scan | None = None
        self._gaps = 0
        self.duplicates = 0
        """Messages with the count of the one before; only the first is kept."""
        self.late = 0
        """Messages that came after a later one; they are among `dropped`."""
        self.corrupt = 0
        """Messages that could not be understood, or whose values no touch could make."""

    @property
    def dropped(self) -> int:
        """Scans that never reached `read`: gaps in the server's count, or not taken in time."""
        return self._gaps + self._inbox.overflowed

    @property
    def refused(self) -> dict[str, int]:
        """Scans that came and were left out, by reason."""
        return {"repeated": self.duplicates, "late": self.late, "spoilt": self.corrupt}

    def open(self, timeout: float) -> None:
        """Connect and wait for the first scan of the sensor.

        Raises:
            DeviceLost: No such server answers within `timeout` [s].
            ConfigError: The address is no WebSocket address.
        """
        self.close()
        deadline_ns = self._clock.now_ns() + round(timeout * SECOND_NS)
        self._inbox = Inbox(self._clock, _CAPACITY)
        self._first = self._newest = self._sequence = None
        self._idle = self._corrupt_in_a_row = self._late_in_a_row = self._restarted_by = 0
        try:
            self._connection = self._exits.enter_context(
                connect(
                    self._config.address,
                    open_timeout=timeout,
                    close_timeout=0.5,
                    compression=None,
                    ping_interval=None,
                    proxy=None,
                )
            )
        except (InvalidURI, ValueError) as error:
            raise ConfigError(
                f"address: {self._config.address!r}: {error}; allowed: ws://host:port"
            ) from error
        except (OSError, EOFError, WebSocketException) as error:
            raise DeviceLost(
                f"{self._config.address}: {error}; check that xela_server runs there, "
                "on the network interface of this address"
            ) from error
        try:
            while self._first is None:
                if self._clock.now_ns() >= deadline_ns:
                    raise DeviceLost(
                        f"{self._config.address}: connected, but no scan of sensor "
                        f"{self._config.sensor!r}; check the sensor's cable and xServ.ini"
                    )
                self._receive()
        except DeviceLost:
            self.close()
            raise
        self._receiver = Receiver(f"xela-{self._config.address}", self._receive, self._inbox)

    def read(self, timeout: float) -> list[dict[str, Any]]:
        """Scans since the last call; see `rig.driver.Driver.read`.

        Raises:
            DeviceLost: The connection broke, fell silent, or tells nonsense.
        """
        if self._receiver is None:
            raise DeviceLost(f"{self._config.address}: not open")
        return self._inbox.take(timeout)

    def describe(self) -> dict[str, Any]:
        """Model, layout and the rate the server stated in its first scan."""
        if self._first is None:
            raise DeviceLost(f"{self._config.address}: not open")
        facts = self._first.facts
        ups = facts.get("ups")
        return {
            "device": "XELA uSkin",
            "address": self._config.address,
            "sensor": self._config.sensor,
            "model": facts.get("model"),
            "taxels": self._config.taxels,
            "unit": "counts",
            "layout": "1.8" if "time" in facts else "1.7",
            "rate_hz": float(ups[0]) if isinstance(ups, list) and ups else None,
            "vendor_calibration": isinstance(facts.get("calibrated"), list),
            "device_clock": "utc" if np.isfinite(self._first.device_t) else "none",
        }

    def close(self) -> None:
        """Stop receiving and disconnect; safe twice."""
        if self._receiver is not None:
            self._receiver.close()
            self._receiver = None
        self._exits.close()
        self._connection = None

    def _receive(self) -> None:
        if self._connection is None:
            raise DeviceLost(f"{self._config.address}: not open")
        try:
            text = self._connection.recv(timeout=_POLL)
        except TimeoutError:
            self._idle += 1
            if self._idle * _POLL >= self._config.silence:
                raise DeviceLost(
                    f"{self._config.address}: no message for {self._config.silence:g} s; "
                    "check xela_server and the sensor's cable"
                ) from None
            return
        except ConnectionClosed as error:
            raise DeviceLost(
                f"{self._config.address}: disconnected ({error}); check xela_server"
            ) from error
        now_ns = self._clock.now_ns()
        self._idle = 0
        try:
            scan = parse(text, self._config.sensor, self._config.taxels)
            if scan is not None:
                self._require_plausible(scan)
        except (ValueError, RecursionError) as error:
            self.corrupt += 1
            self._corrupt_in_a_row += 1
            if self._corrupt_in_a_row >= _CORRUPT_IN_A_ROW:
                raise DeviceLost(
                    f"{self._config.address}: {_CORRUPT_IN_A_ROW} bad messages in a row, "
                    f"the last: {error}; check the bench file's sensor and taxels"
                ) from error
            return
        self._corrupt_in_a_row = 0
        if scan is not None:
            self._keep(scan, now_ns)

    def _require_plausible(self, scan: Scan) -> None:
        if self._newest is None:
            return
        moved = np.abs(scan.counts - self._newest.counts) > _JUMP
        if moved.mean() > _JUMPED:
            raise ValueError(
                f"data: {moved.sum()} of {moved.size} values moved by more than {_JUMP} counts in "
                "one scan; did the server change its scale?"
            )

    def _keep(self, scan: Scan, t_ns: int) -> None:
        if self._sequence is None:
            self._first = scan
            self._sequence = scan.message - 1
        step = scan.message + self._restarted_by - self._sequence
        if step == 0:
            self.duplicates += 1
            return
        if step < 0:
            if self._is_late(scan, step):
                self.late += 1
                self._late_in_a_row += 1
                return
            logger.warning("%s: the count went back to %d", self._config.address, scan.message)
            self._restarted_by += 1 - step
            step = 1
        self._late_in_a_row = 0
        self._newest = scan
        self._gaps += step - 1
        self._sequence += step
        self._inbox.put(
            {"value": scan.counts, "device_t": scan.device_t, "seq": self._sequence}, t_ns
        )

    def _is_late(self, scan: Scan, step: int) -> bool:
        """Whether a scan with a number behind the newest is late, and not the first of a restart.

        A server that began to count anew goes on in time; without times, it stays behind.
        """
        if step < -_LATE or self._late_in_a_row >= _LATE_IN_A_ROW or self._newest is None:
            return False
        return not scan.device_t > self._newest.device_t
