"""Emulated `xela_server` that plays recorded taxels: see rig/mock/player.py.

The driver needs one scan to open. It gets the first row's values under the number before; the
recorded rows follow under their recorded numbers and device times.
"""

from __future__ import annotations

import contextlib
import json
import math

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import Server, ServerConnection
from websockets.sync.server import serve as listen

from rig.core.emulation import ThreadedEmulator
from rig.devices.playback.wire import RecordedStream, stated_rate
from rig.devices.taxels.xela_emulator import emit

PORT = 5000


class XelaPlayback(ThreadedEmulator):
    """Emulated server that sends scans over WebSocket.

    Args:
        recorded: A taxel stream.
        host: Address to listen on.
    """

    window = 128
    """The driver keeps 10 000 scans for a late recorder."""

    def __init__(self, recorded: RecordedStream, host: str) -> None:
        super().__init__()
        self._host = host
        rows = slice(recorded.rows.start, recorded.rows.stop)
        stream = recorded.stream
        counts = stream.array("value")[rows].reshape(-1, 48)
        self._counts = counts if len(counts) else np.zeros((1, 48), np.int32)
        self._seq = stream.array("seq")[rows].tolist() or [1]
        self._device_t = stream.array("device_t")[rows].tolist() or [math.nan]
        device = stream.attrs.get("device") or {}
        self._layout = str(device.get("layout") or "1.8")
        self._rate_hz = stated_rate(stream)
        self._server: Server | None = None
        self._client: ServerConnection | None = None

    @property
    def address(self) -> str:
        """WebSocket address."""
        return f"ws://{self._host}:{PORT}"

    def start(self) -> None:
        """Start listening.

        Raises:
            OSError: The address is not available.
        """
        self._server = listen(
            self._greet, self._host, PORT, compression=None, ping_interval=None, close_timeout=0.5
        )
        self._run_threads(self._server.serve_forever)

    def send(self, place: int) -> None:
        """Send one scan, its number and time as recorded.

        Raises:
            OSError: The client is gone.
        """
        client = self._client
        if client is None:
            raise OSError("no client is connected")
        try:
            client.send(self._message(self._seq[place], place))
        except ConnectionClosed as error:
            raise OSError(f"client gone: {error}") from error

    def idle(self) -> None:
        """Do nothing: the server sends only scans."""

    def wake(self) -> None:
        """Do nothing: the driver's waits are short."""

    def _disconnect(self) -> None:
        if self._server is not None:
            self._server.shutdown()
            self._server = None

    def _message(self, number: int, place: int) -> str:
        return emit(
            number,
            self._device_t[place],
            self._counts[place].tolist(),
            layout=self._layout,
            ups=self._rate_hz,
        )

    def _greet(self, connection: ServerConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            connection.send(json.dumps({"message": "Welcome"}))
            connection.send(self._message(self._seq[0] - 1, 0))
            self._client = connection
            # The connection lives as long as this thread; the player sends from its own thread.
            while not self._ending.is_set():
                with contextlib.suppress(TimeoutError):
                    connection.recv(timeout=0.1)
