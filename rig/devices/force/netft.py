"""ATI Net F/T driver: settings by HTTP, records by UDP.

The wire format is described in rig/devices/force/netft_wire.py.

The box streams to one client only: the last one to start a stream gets it, and the previous client
receives nothing more. The box's own bias is volatile and global, so it is not used; tare on the
host.
"""

import contextlib
import http.client
import io
import logging
import socket
import struct
import threading
from typing import Any

import numpy as np

from rig.core.clock import SECOND_NS, Clock, ClockAnchor
from rig.core.driver import CORRUPT_IN_A_ROW, ReceivingDriver
from rig.core.errors import ConfigError, DeviceLost
from rig.devices.force import netft_wire as wire
from rig.devices.force.settings import NetFtConfig

logger = logging.getLogger(__name__)

# Arrival times of UDP packets, from the kernel.
#
# A thread that waits for the interpreter lock gets a packet some milliseconds after its arrival (in
# a busy process 7 ms in the median, 37 ms at worst, measured at 1 kHz). The kernel timestamps each
# packet on arrival, on the UTC clock; here the time is converted to the monotonic clock.

# Linux's number; the socket module does not name it before Python 3.14.
_SO_TIMESTAMPNS = 35
_TIMESPEC = struct.Struct("@ll")
_ANCHOR_NS = SECOND_NS // 10
# UTC is stepped and slewed: the conversion between the clocks is never older than this.
_AGE_MAX_NS = 10 * SECOND_NS


class StampedSocket:
    """A UDP socket that returns packets with their time of arrival; its timeout is kept.

    The clock is for packets that the kernel did not timestamp, or whose timestamp is ahead or more
    than 10 s behind because UTC was set.
    """

    def __init__(self, udp: socket.socket, clock: Clock) -> None:
        self._udp = udp
        self._clock = clock
        self._anchor = ClockAnchor.take()
        if hasattr(socket, "SO_PRIORITY"):  # Linux
            with contextlib.suppress(OSError):
                udp.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)

    def receive(self, size: int) -> tuple[bytes, int]:
        """Return the next packet and its arrival [ns]."""
        packet, ancillary, _, _ = self._udp.recvmsg(size, 64)
        now_ns = self._clock.now_ns()
        if not 0 <= now_ns - self._anchor.t0_ns < _ANCHOR_NS:
            self._anchor = ClockAnchor.take()
        for level, kind, data in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS):
                seconds, nanoseconds = _TIMESPEC.unpack(data)
                utc_ns = seconds * SECOND_NS + nanoseconds
                t_ns = utc_ns - self._anchor.utc_ns + self._anchor.t0_ns
                if now_ns - _AGE_MAX_NS < t_ns <= now_ns:
                    return packet, t_ns
        return packet, now_ns


# Pages of the box, read within a time limit for the whole answer. A time limit per packet, as
# `urllib` has, never ends for a box that sends one byte per second. No proxy is used either.

_PAGE_MOST = 1 << 20


class _UntilDeadline(io.RawIOBase):
    """A connection to read from until a deadline; each read waits for the remaining time only."""

    def __init__(self, connection: socket.socket, clock: Clock, deadline_ns: int) -> None:
        self._connection = connection
        self._clock = clock
        self._deadline_ns = deadline_ns

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        """Receive into `buffer`; return the number of bytes, 0 at the end."""
        self._connection.settimeout(remaining(self._clock, self._deadline_ns))
        return self._connection.recv_into(buffer)

    def makefile(self, mode: str) -> io.BufferedReader:
        """Return the buffered reader that `http.client` asks a socket for."""
        return io.BufferedReader(self)


def remaining(clock: Clock, deadline_ns: int) -> float:
    """Return the time until a deadline [s]."""
    left_ns = deadline_ns - clock.now_ns()
    if left_ns <= 0:
        raise TimeoutError("timed out")
    return left_ns / SECOND_NS


def fetch(host: str, port: int, path: str, clock: Clock, deadline_ns: int) -> bytes:
    """Return the body of a page, at most 1 MB, whole by the deadline."""
    with socket.create_connection((host, port), remaining(clock, deadline_ns)) as connection:
        connection.sendall(
            f"GET /{path} HTTP/1.1\r\nHost: {host}:{port}\r\nConnection: close\r\n\r\n".encode()
        )
        reader: Any = _UntilDeadline(connection, clock, deadline_ns)
        response = http.client.HTTPResponse(reader, method="GET")
        try:
            response.begin()
            if response.status != http.client.OK:
                raise OSError(f"HTTP status {response.status} {response.reason}")
            return response.read(_PAGE_MOST)
        finally:
            response.close()


# The page is read again this often: the box's web server is slow, and shares the processor that
# produces the records [s].
_PERIOD = 1.0
_POLL = 0.1
_CAPACITY = 60_000
# A packet this many places late is not reordered: the box has begun a new stream.
_RESTART = 1000
# A packet this far ahead is not of this stream: silence would have ended it long before [s].
_AHEAD = 10.0
_IN_A_ROW = f"({CORRUPT_IN_A_ROW} in a row)"
_PAGE_TIMEOUT = 1.0


def _difference(opened: wire.Page, now: wire.Page) -> str:
    names = ("counts_per_force", "counts_per_torque", "force_unit", "torque_unit", "rate_hz")
    return ", ".join(
        f"{name} from {getattr(opened, name)} to {getattr(now, name)}"
        for name in names
        if getattr(opened, name) != getattr(now, name)
    )


class NetFtDriver(ReceivingDriver):
    """Stream of a Net F/T box.

    Columns: value (6,) float64 [N, N m], seq int64 (rdt_sequence, unwrapped), status int64, t_ns.
    """

    def __init__(self, config: NetFtConfig, clock: Clock) -> None:
        rejects = ("repeated", "late", "corrupt")
        super().__init__(f"{config.host}:{config.udp_port}", clock, _CAPACITY, rejects)
        self._config = config
        self._socket: socket.socket | None = None
        self._stamped: StampedSocket | None = None
        self._page: wire.Page | None = None
        self._page_watch: threading.Thread | None = None
        self._scale = np.ones(6)
        self._sequence = -1

    def _connect(self, timeout: float) -> None:
        """Read the settings, set the rate, start the stream and wait for its first record."""
        self._sequence = -1
        self._page = self._settled_page(self._deadline_ns)
        self._scale = np.repeat(self._page.scale(), 3)
        udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            udp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
            udp.connect((self._config.host, self._config.udp_port))
            udp.send(wire.emit_request(wire.COMMAND_REALTIME))
            udp.settimeout(self._left())
            stamped = StampedSocket(udp, self._clock)
            self._sort(*stamped.receive(64))
        except OSError as error:
            udp.close()
            raise DeviceLost(
                f"{self._where}: no RDT records ({error}); check that RDT is enabled on the "
                "box's Communications page and that no firewall blocks UDP"
            ) from error
        udp.settimeout(_POLL)
        self._socket, self._stamped = udp, stamped
        self._page_watch = threading.Thread(
            target=self._watch_page, args=(self._page,), name="netft-page", daemon=True
        )
        self._page_watch.start()

    def describe(self) -> dict[str, Any]:
        """Return units, counts per unit, rate and product as stated by the box."""
        if self._page is None:
            raise self._not_open()
        return {
            "device": "ATI Net F/T",
            "address": self._where,
            "product": self._page.product,
            "serial": self._page.serial,
            "rate_hz": float(self._page.rate_hz),
            "force_unit": self._page.force_unit,
            "torque_unit": self._page.torque_unit,
            "counts_per_force": self._page.counts_per_force,
            "counts_per_torque": self._page.counts_per_torque,
            "status": wire.status_text(self._page.runstat),
        }

    def _release(self) -> None:
        if self._page_watch is not None:
            self._page_watch.join()
            self._page_watch = None
        if self._socket is not None:
            try:
                self._socket.send(wire.emit_request(wire.COMMAND_STOP))
            except OSError as error:
                logger.debug("%s: stop not sent: %s", self._where, error)
            self._socket.close()
            self._socket = self._stamped = None

    def _get(self, path: str, deadline_ns: int) -> bytes:
        url = f"http://{self._config.host}:{self._config.http_port}/{path}"
        try:
            return fetch(self._config.host, self._config.http_port, path, self._clock, deadline_ns)
        except (OSError, http.client.HTTPException) as error:
            raise DeviceLost(
                f"{url}: {error}; check the box's power, cable and IP address"
            ) from error

    def _read_page(self, deadline_ns: int) -> wire.Page:
        content = self._get("netftapi2.xml", deadline_ns)
        try:
            page = wire.parse_page(content)
        except ValueError as error:
            raise DeviceLost(
                f"{self._config.host}: netftapi2.xml: {error}; check that it is a Net F/T box"
            ) from error
        try:
            page.scale()
        except ConfigError as error:
            raise ConfigError(f"{self._config.host}: netftapi2.xml: {error}") from error
        return page

    def _settled_page(self, deadline_ns: int) -> wire.Page:
        page = self._read_page(deadline_ns)
        if page.runstat & wire.ERROR_MASK:
            raise DeviceLost(
                f"{self._config.host}: the box reports 0x{page.runstat:08x}: "
                f"{wire.status_text(page.runstat)}; check the transducer's cable, then power-cycle"
            )
        requested_hz = round(self._config.rate_hz)
        if page.rate_hz != requested_hz:
            self._get(f"comm.cgi?comrdtrate={requested_hz}", deadline_ns)
            page = self._read_page(deadline_ns)
        if abs(page.rate_hz - self._config.rate_hz) > 0.01 * self._config.rate_hz:
            raise ConfigError(
                f"{self._config.host}: comrdtrate: asked {self._config.rate_hz:g} Hz, got "
                f"{page.rate_hz} Hz; allowed: rates that the box's Communications page accepts"
            )
        return page

    def _watch_page(self, opened: wire.Page) -> None:
        """End the stream when the settings of the box differ from those it was opened with.

        A record does not contain its units: changing them on the box's web page during a stream
        changes the meaning of every later count.
        """
        reachable, unchanged_ns = True, self._clock.now_ns()
        while not self._stopping.wait(_PERIOD):
            start_ns = self._clock.now_ns()
            try:
                page = self._read_page(start_ns + round(_PAGE_TIMEOUT * SECOND_NS))
                difference = _difference(opened, page)
                reachable = True
            except ConfigError as error:
                difference = str(error)
            except DeviceLost as error:
                # The records show if the box is alive; a busy web server is no reason to stop.
                if reachable:
                    logger.warning("settings not read again: %s", error)
                reachable = False
                continue
            if difference:
                self._inbox.fail(
                    f"{self._where}: its settings were changed while it streamed ({difference}); "
                    f"values after t_ns = {unchanged_ns} must not be trusted; restore its "
                    "settings, then resume"
                )
                return
            unchanged_ns = start_ns

    def _receive(self) -> None:
        if self._stamped is None:
            raise self._not_open()
        try:
            packet, t_ns = self._stamped.receive(64)
        except TimeoutError:
            self._count_wait(
                _POLL,
                self._config.silence,
                f"no record for {self._config.silence:g} s; check the box's power and cable, and "
                "that no other client has started a stream (the box serves only the latest one)",
            )
            return
        except OSError as error:
            raise DeviceLost(f"{self._where}: {error}; check the box's power") from error
        self._waits = 0
        self._sort(packet, t_ns)

    def _sort(self, packet: bytes, t_ns: int) -> None:
        if len(packet) != wire.RECORD.size:
            self._count_corrupt(
                f"packets of {len(packet)} bytes; a record has {wire.RECORD.size} {_IN_A_ROW}"
            )
            return
        rdt_sequence, _, status, *counts = wire.RECORD.unpack(packet)
        if self._sequence < 0:
            self._sequence = rdt_sequence - 1
        step = (rdt_sequence - self._sequence) & 0xFFFFFFFF
        step -= (step & 0x80000000) << 1
        if not -_RESTART <= step <= _AHEAD * max(self._config.rate_hz, _RESTART):
            went = "went back" if step < 0 else "jumped"
            self._count_corrupt(
                f"the sequence {went} from {self._sequence} to {rdt_sequence}; the box was "
                "restarted, another client started a stream, or the packets are garbage "
                f"{_IN_A_ROW}"
            )
            return
        self._corrupt_in_a_row = 0
        if step <= 0:
            self.rejected["late" if step else "repeated"] += 1
            return
        self._gaps += step - 1
        self._sequence += step
        value = np.array(counts, np.float64) * self._scale
        self._inbox.put({"value": value, "seq": self._sequence, "status": status}, t_ns)
