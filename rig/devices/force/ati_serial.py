"""Driver of an ATI stand-alone F/T controller on RS-232.

The wire format is described in rig/devices/force/ati_serial_wire.py. The controller has no clock
and no counter: `seq` counts records as they arrive, with a gap for each known loss, and a record's
time is that of its last byte on the host. The controller's own bias is not used; tare on the host.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from rig.core.clock import SECOND_NS, Clock
from rig.core.errors import ConfigError, DeviceLost
from rig.devices.force.ati_serial_wire import PROMPT, BinaryFramer, Found, TextFramer, parse
from rig.devices.force.sample_clock import LOST_BEFORE
from rig.devices.force.serial_driver import SerialDriver
from rig.devices.force.settings import RECORD_BYTES, AtiSerialConfig

logger = logging.getLogger(__name__)

# A prompt ends a reply after this silence: 38 bytes' time at 38400 baud [s].
_POLL = 0.01
# Without a prompt, this silence does: USB adapters hold bytes back for 16 ms [s].
_QUIET = 0.05
_WRITE_TIMEOUT = 1.0
_CAPACITY = 10_000
# A jump of 1 N comes with one of 10 N mm: the levers on a Nano17 are some 10 mm.
_N_PER_N_MM = 0.1
# Restarts in a row that bring no second record: more cannot be explained by lost bytes.
_DOUBTS_MAX = 20


class AtiSerialDriver(SerialDriver):
    """Stream of an ATI stand-alone controller.

    Columns: value (6,) float64 [N, N m] in the transducer's frame, seq int64 (host's count), status
    int64 (the controller's error number, and rig/devices/force/sample_clock.py), t_ns.
    """

    POWER = "the controller's power"
    FAREWELL = b"\r"

    def __init__(self, config: AtiSerialConfig, clock: Clock) -> None:
        super().__init__(config.address, clock, _CAPACITY)
        self._config = config
        force, torque = 1 / config.counts_per_n, 1e-3 / config.counts_per_n_mm
        self._scale = np.repeat([force, torque], 3)
        self._framer: TextFramer | BinaryFramer = TextFramer()
        self._sequence = -1
        self._idle = self._in_vain = self._fruitless = 0
        self._interrupted = False
        self._replies: dict[str, str] = {}

    def open(self, timeout: float) -> None:
        """Stop any stream, set the record format, check it on one record, start the stream.

        Raises:
            DeviceLost: No such port, or no controller answers within `timeout` [s].
            ConfigError: Its records are not in the requested format.
        """
        self._reset()
        self._sequence, self._interrupted = -1, False
        self._idle = self._in_vain = self._fruitless = 0
        deadline_ns = self._clock.now_ns() + round(timeout * SECOND_NS)
        config = self._config
        with self._errors():
            self._connect(config.baud, timeout=_POLL, write_timeout=_WRITE_TIMEOUT)
        try:
            with self._errors():
                self._silence(deadline_ns)
                self._set_up(deadline_ns)
                self._check_form(deadline_ns)
                self._start_stream(deadline_ns)
        except (DeviceLost, ConfigError):
            self.close()
            raise
        self._start_receiving(f"ati-{config.address}")

    def describe(self) -> dict[str, Any]:
        """Return the settings, and the controller's replies to them."""
        self._open_port()
        config = self._config
        return {
            "device": "ATI F/T controller, RS-232",
            "address": config.address,
            "baud": config.baud,
            "records": config.records,
            "rate_max_hz": config.rate_max_hz,
            "counts_per_n": config.counts_per_n,
            "counts_per_n_mm": config.counts_per_n_mm,
            "average": config.average,
            "replies": dict(self._replies),
            "device_clock": "none",
            "numbering": "host",
        }

    def _silence(self, deadline_ns: int) -> None:
        """End a stream that may be running, up to a prompt with nothing after it."""
        port = self._open_port()
        while True:
            port.reset_input_buffer()
            port.write(b"\r")
            if self._reply(deadline_ns, "any command").endswith(PROMPT):
                return

    def _reply(self, deadline_ns: int, asked: str) -> bytes:
        """Return the bytes received until the line is quiet."""
        port, content, quiet = self._open_port(), b"", 0.0
        while not content or quiet < (_POLL if content.endswith(PROMPT) else _QUIET):
            if self._clock.now_ns() >= deadline_ns:
                what = f"got {content[-40:]!r}" if content else "no answer"
                raise DeviceLost(
                    f"{self._config.address}: {what} to {asked}; check the cable, the "
                    f"controller's power, and its baud rate against {self._config.baud}"
                )
            more = port.read(max(1, port.in_waiting))
            content, quiet = content + more, 0.0 if more else quiet + _POLL
        return content

    def _command(self, text: str, deadline_ns: int) -> bytes:
        """Return the controller's answer, without echo and prompt."""
        echo = text.encode() + b"\r\n"
        self._open_port().write(text.encode() + b"\r")
        reply = self._reply(deadline_ns, text)
        if not reply.startswith(echo) or not reply.endswith(PROMPT):
            raise DeviceLost(
                f"{self._config.address}: {reply[:40]!r} to {text}; expected its echo and a prompt"
            )
        return reply[len(echo) : -len(PROMPT)]

    def _set_up(self, deadline_ns: int) -> None:
        form = "CD B" if self._config.records == "binary" else "CD A"
        self._replies = {}
        for text in (form, "CD R", f"SA {self._config.average}"):
            reply = self._command(text, deadline_ns).decode("ascii", "replace").strip()
            if reply:
                # Manuals differ on the answer to a setting; it is kept for the session's record.
                logger.warning("%s: %s: %s", self._config.address, text, reply)
                self._replies[text] = reply

    def _check_form(self, deadline_ns: int) -> None:
        """Check the format on one record, since settings cannot be queried.

        Raises:
            ConfigError: The record has another format.
        """
        form = self._config.records
        reply = self._command("QR", deadline_ns)
        for content in (reply, reply + b"\r\n"):
            if parse(content, form) is not None:
                return
        raise ConfigError(
            f"{self._config.address}: records: asked {form}, got {len(reply)} bytes "
            f"{reply[:48]!r}; allowed: {RECORD_BYTES[form]} bytes; does the controller take CD A, "
            "CD B and CD R?"
        )

    def _start_stream(self, deadline_ns: int) -> None:
        port = self._open_port()
        if self._config.records == "binary":
            jumps = self._config.jump * np.array([1.0, 1.0, 1.0, *[1e-3 / _N_PER_N_MM] * 3])
            self._framer = BinaryFramer(tuple((jumps / self._scale).tolist()))
        else:
            self._framer = TextFramer()
        port.write(b"QS\r")
        echo = b""
        while not echo.endswith(b"QS\r\n"):
            if self._clock.now_ns() >= deadline_ns or len(echo) > 64:
                raise DeviceLost(f"{self._config.address}: {echo[-40:]!r} to QS; expected its echo")
            echo += port.read(1)

    def _receive(self) -> None:
        port = self._open_port()
        with self._errors():
            content = port.read(max(RECORD_BYTES[self._config.records], port.in_waiting))
        now_ns = self._clock.now_ns()
        if not content:
            # Counts waits instead of using the clock: after a suspension of this process, bytes
            # waiting in the port are received before anything counts as silence.
            self._idle += 1
            if self._idle * _POLL >= self._config.silence:
                raise DeviceLost(
                    f"{self._config.address}: no record for {self._config.silence:g} s; check the "
                    "controller's power and cable"
                )
            return
        self._idle = 0
        self._fruitless += len(content)
        for found in self._framer.feed(content):
            self._keep(found, now_ns)
        if self._framer.doubtful:
            self._start_anew()
        elif self._fruitless * 10 / self._config.baud >= self._config.silence:
            raise DeviceLost(
                f"{self._config.address}: {self._fruitless} bytes without a complete record; check "
                f"the cable, and the baud rate against {self._config.baud}"
            )

    def _keep(self, found: Found, now_ns: int) -> None:
        self._fruitless = self._in_vain = 0
        self.corrupt += found.lost
        self._sequence += 1 + found.lost
        status = found.record.error
        if found.lost or self._interrupted:
            status |= LOST_BEFORE
            self._interrupted = False
        value = np.array(found.record.counts, np.float64) * self._scale
        # The bytes after it arrived later, at ten bits each on the line.
        t_ns = now_ns - found.behind * 10 * SECOND_NS // self._config.baud
        self._inbox.put({"value": value, "seq": self._sequence, "status": status}, t_ns)

    def _start_anew(self) -> None:
        """Stop and start after a doubtful record, to find again where a record begins."""
        self.corrupt += 1
        self._sequence += 1
        self._interrupted = True
        self._in_vain += 1
        if self._in_vain >= _DOUBTS_MAX:
            raise DeviceLost(
                f"{self._config.address}: {_DOUBTS_MAX} restarts in a row without two consistent "
                "records; check the cable, the baud rate, and `jump_n`, or use `records: ascii`"
            )
        deadline_ns = self._clock.now_ns() + round(self._config.silence * SECOND_NS)
        with self._errors():
            self._silence(deadline_ns)
            self._start_stream(deadline_ns)
