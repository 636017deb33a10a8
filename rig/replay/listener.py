"""A TCP port whose clients are greeted one after the other, the latest one kept."""

from __future__ import annotations

import contextlib
import logging
import socket
import threading
from collections.abc import Callable

logger = logging.getLogger(__name__)

_POLL = 0.1
_GREETING = 5.0
# How long a client may take over its side of the greeting [s].


class Listener:
    """Accepts clients; `send` goes to the latest one that was greeted.

    Args:
        host: Address to listen on.
        port: Port.
        greet: Answers a new client until it is ready for rows; False when it went before.
    """

    def __init__(self, host: str, port: int, greet: Callable[[socket.socket], bool]) -> None:
        self.host = host
        self.port = port
        self._greet = greet
        self._server: socket.socket | None = None
        self._client: socket.socket | None = None
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Listen.

        Raises:
            OSError: The address cannot be had.
        """
        server = socket.socket()
        server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            server.bind((self.host, self.port))
            server.listen(4)
        except OSError:
            server.close()
            raise
        server.settimeout(_POLL)
        self._server = server
        self._thread = threading.Thread(target=self._accept, args=(server,), name="player-accept")
        self._thread.start()

    @property
    def connected(self) -> bool:
        """Whether a client is there, ready for rows."""
        return self._client is not None

    def send(self, data: bytes) -> None:
        """Send all of `data`, waiting as long as the client lets it wait.

        Raises:
            OSError: There is no client, or it is gone.
        """
        client = self._client
        if client is None:
            raise OSError("no client is connected")
        client.sendall(data)

    def close(self) -> None:
        """Disconnect and stop; safe twice."""
        self._ending.set()
        client = self._client
        if client is not None:
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        for opened in (client, self._server):
            if opened is not None:
                opened.close()
        self._client = self._server = None

    def _accept(self, server: socket.socket) -> None:
        while not self._ending.is_set():
            try:
                client, _ = server.accept()
            except TimeoutError:
                continue
            client.settimeout(_GREETING)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            try:
                greeted = self._greet(client)
            except (OSError, ValueError) as error:
                logger.debug("client gone in the greeting: %s", error)
                greeted = False
            if not greeted:
                client.close()
                continue
            client.settimeout(None)
            before, self._client = self._client, client
            if before is not None:
                before.close()
