"""XELA uSkin driver: receives scans of `xela_server` over WebSocket.

The messages are described in rig/devices/taxels/xela_wire.py. Scans that are duplicate or late, or
that have values no touch could cause, are counted and rejected.
"""

import contextlib
import logging
from typing import Any

import numpy as np
from websockets.exceptions import ConnectionClosed, InvalidURI, WebSocketException
from websockets.sync.client import ClientConnection, connect

from rig.core.clock import Clock
from rig.core.driver import CORRUPT_IN_A_ROW, ReceivingDriver
from rig.core.errors import ConfigError, DeviceLost
from rig.devices.taxels.settings import XelaConfig
from rig.devices.taxels.xela_wire import Scan, parse

logger = logging.getLogger(__name__)

_POLL = 0.1
_CAPACITY = 10_000
# A scan at most this far behind the newest is late. Beyond it, or after this many late scans in a
# row, the server has restarted its count.
_LATE = 50
_LATE_IN_A_ROW = 10
# Counts, and fraction of all values: no touch moves that many by an eighth of the range in one scan
# (the largest step in three public recordings of grasps, 779 scans, is 527 counts).
_JUMP, _JUMPED = 8192, 0.5


class XelaDriver(ReceivingDriver):
    """Stream of one uSkin sensor.

    Columns: value (taxels, axes) int32 raw counts, device_t float64 [s], seq int64, t_ns.
    """

    def __init__(self, config: XelaConfig, clock: Clock) -> None:
        super().__init__(config.address, clock, _CAPACITY, ("repeated", "late", "corrupt"))
        self._config = config
        self._exits = contextlib.ExitStack()
        self._connection: ClientConnection | None = None
        self._first: Scan | None = None
        self._sequence: int | None = None
        self._restarted_by = 0
        self._late_in_a_row = 0
        self._newest: Scan | None = None

    def _connect(self, timeout: float) -> None:
        self._first = self._newest = self._sequence = None
        self._late_in_a_row = self._restarted_by = 0
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
        self._receive_first(
            f"connected, but no scan of sensor {self._config.sensor!r}; check the sensor's cable "
            "and xServ.ini"
        )

    def describe(self) -> dict[str, Any]:
        """Return model, layout and the rate that the server stated in its first scan."""
        if self._first is None:
            raise self._not_open()
        description = self._first.description
        ups = description.get("ups")
        return {
            "device": "XELA uSkin",
            "address": self._config.address,
            "sensor": self._config.sensor,
            "model": description.get("model"),
            "taxels": self._config.rows * self._config.columns,
            "unit": "counts",
            "layout": "1.8" if "time" in description else "1.7",
            "rate_hz": float(ups[0]) if isinstance(ups, list) and ups else None,
            "vendor_calibration": isinstance(description.get("calibrated"), list),
            "device_clock": "utc" if np.isfinite(self._first.device_t) else "none",
        }

    def _release(self) -> None:
        self._exits.close()
        self._connection = None

    def _receive(self) -> None:
        if self._connection is None:
            raise self._not_open()
        try:
            text = self._connection.recv(timeout=_POLL)
        except TimeoutError:
            self._count_wait(
                _POLL,
                self._config.silence,
                f"no message for {self._config.silence:g} s; check xela_server and the sensor's "
                "cable",
            )
            return
        except ConnectionClosed as error:
            raise DeviceLost(
                f"{self._config.address}: disconnected ({error}); check xela_server"
            ) from error
        now_ns = self._clock.now_ns()
        self._waits = 0
        try:
            rows, columns, axes = self._config.shape
            scan = parse(text, self._config.sensor, rows * columns, axes)
            if scan is not None:
                self._require_plausible(scan)
        except (ValueError, RecursionError) as error:
            self._count_corrupt(
                f"{CORRUPT_IN_A_ROW} bad messages in a row, the last: {error}; check the bench "
                "file's sensor and taxels"
            )
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
            self.rejected["repeated"] += 1
            return
        if step < 0:
            if self._is_late(scan, step):
                self.rejected["late"] += 1
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
        """Return True if a scan numbered below the newest is late, and not the first of a restart.

        After a restart the times still increase; without times, the numbers stay below the newest.
        """
        if step < -_LATE or self._late_in_a_row >= _LATE_IN_A_ROW or self._newest is None:
            return False
        return not scan.device_t > self._newest.device_t
