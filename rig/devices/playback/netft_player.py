"""Emulated Net F/T box that plays a recorded force stream: see rig/mock/player.py.

The driver needs one record to open. It gets the first row's values under the number before, and
counts on from there; the recorded rows follow under their recorded numbers.
"""

from __future__ import annotations

import socket
from functools import partial
from urllib.parse import SplitResult

import numpy as np

from rig.core.emulation import DeviceHandler, DeviceServer, ThreadedEmulator
from rig.devices.force.netft_wire import (
    COMMAND_REALTIME,
    COMMAND_STOP,
    RECORD,
    emit_page,
    parse_request,
)
from rig.devices.playback.wire import RecordedStream, force_bias, force_counts, force_page

HTTP_PORT, UDP_PORT = 8080, 49152
_POLL = 0.1


class NetFtPlayback(ThreadedEmulator):
    """Emulated box that serves its settings page and its records.

    Args:
        recorded: A force stream.
        host: Address to listen on.
    """

    window = 128
    """A socket of the default size holds 250 packets."""

    def __init__(self, recorded: RecordedStream, host: str) -> None:
        super().__init__()
        self._host = host
        self._page = emit_page(force_page(recorded.stream))
        rows = slice(recorded.rows.start, recorded.rows.stop)
        value = recorded.stream.array("value")[rows]
        counts = force_counts(value, force_bias(recorded.stream), force_page(recorded.stream))
        self._counts = counts if len(counts) else np.zeros((1, 6), np.int64)
        self._seq = (recorded.stream.array("seq")[rows] & 0xFFFFFFFF).tolist() or [1]
        self._status = recorded.stream.array("status")[rows].tolist() or [0]
        self._udp: socket.socket | None = None
        self._http: _PageServer | None = None
        self._peer: tuple[str, int] | None = None

    @property
    def address(self) -> str:
        """Host and UDP port."""
        return f"{self._host}:{UDP_PORT}"

    def start(self) -> None:
        """Start listening.

        Raises:
            OSError: The address or a port is not available.
        """
        udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            udp.bind((self._host, UDP_PORT))
            udp.settimeout(_POLL)
            self._http = _PageServer((self._host, HTTP_PORT), self._page)
        except OSError:
            udp.close()
            raise
        self._udp = udp
        self._run_threads(
            partial(self._take_commands, udp), partial(self._http.serve_forever, 0.05)
        )

    def send(self, place: int) -> None:
        """Send one record, as recorded.

        Raises:
            OSError: No client has requested records.
        """
        if self._udp is None or self._peer is None:
            raise OSError("no client requested records")
        self._udp.sendto(self._packet(self._seq[place], place), self._peer)

    def idle(self) -> None:
        """Do nothing: a box sends only records."""

    def wake(self) -> None:
        """Do nothing: the driver's waits are short."""

    def _disconnect(self) -> None:
        if self._http is not None:
            self._http.shutdown()
            self._http.server_close()
            self._http = None

    def _release(self) -> None:
        if self._udp is not None:
            self._udp.close()
            self._udp = None

    def _packet(self, seq: int, place: int) -> bytes:
        counts = self._counts[place].tolist()
        return RECORD.pack(seq, seq, self._status[place], *counts)

    def _take_commands(self, udp: socket.socket) -> None:
        while not self._ending.is_set():
            try:
                packet, peer = udp.recvfrom(64)
            except OSError:
                continue
            command, _ = parse_request(packet) or (None, 0)
            if command == COMMAND_REALTIME:
                udp.sendto(self._packet((self._seq[0] - 1) & 0xFFFFFFFF, 0), peer)
                self._peer = peer
            elif command == COMMAND_STOP:
                self._peer = None


class _PageServer(DeviceServer):
    """Server of netftapi2.xml, the same for every request."""

    def __init__(self, address: tuple[str, int], page: bytes) -> None:
        self.page = page
        super().__init__(address, _PageHandler)


class _PageHandler(DeviceHandler):
    server: _PageServer
    timeout = 5.0

    def get(self, url: SplitResult) -> None:
        if url.path == "/netftapi2.xml":
            self.answer(self.server.page, "text/xml")
        else:
            self.send_error(404)
