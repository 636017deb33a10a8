"""The port through which faults are put into a running emulator: `make faults`, and the tests.

One JSON object a line, {"fault": NAME, ...}, each answered by one: {"ok": true, ...} with how the
device is, or {"ok": false, "error": TEXT}. It lies beside the device's own protocol, so that it
answers while the device is unplugged or frozen, and only on the emulator's own loopback address.
"""

from __future__ import annotations

import json
import logging
import socket
import socketserver
import sys
import threading
from collections.abc import Callable
from typing import Any

logger = logging.getLogger(__name__)

PORTS = {
    "arm": 31000,
    "force": 31001,
    "camera": 31002,
    "taxels": 31003,
    "gripper": 31004,
    "pedal": 31005,
    "spacemouse": 31006,
}
"""Fault port of each device of a mock bench, at the bench's own loopback address."""

Apply = Callable[..., dict[str, Any]]
"""Called with the name of the fault and its values; tells how the device is.

It raises ValueError, KeyError or TypeError when it knows no such fault or misses a value.
"""

_LONGEST = 1 << 16
# A line longer than this is no request [bytes].


def answer(apply: Apply, line: str) -> str:
    """The answer to one line."""
    try:
        request = json.loads(line)
        return json.dumps({"ok": True, **apply(**request)})
    except (ValueError, KeyError, TypeError) as error:
        return json.dumps({"ok": False, "error": f"{type(error).__name__}: {error}"})


def inject(host: str, port: int, fault: str, **values: Any) -> dict[str, Any]:
    """Put a fault into the emulator whose fault port this is; how its device is.

    Raises:
        OSError: No emulator there.
        ValueError: The emulator does not know the fault, or misses a value.
    """
    with (
        socket.create_connection((host, port), 5.0) as connection,
        connection.makefile("rw", encoding="utf-8", newline="\n") as lines,
    ):
        lines.write(json.dumps({"fault": fault, **values}) + "\n")
        lines.flush()
        line = lines.readline()
    if not line:
        raise ConnectionResetError(f"{host}:{port}: closed without an answer")
    reply: dict[str, Any] = json.loads(line)
    if not reply.pop("ok"):
        raise ValueError(f"fault {fault!r} {values}: {reply['error']}")
    return reply


class FaultPort:
    """Serves the fault port of one emulator, in threads of its own.

    Args:
        host: Loopback address.
        port: TCP port.
        apply: What a request does.
    """

    def __init__(self, host: str, port: int, apply: Apply) -> None:
        self._address = (host, port)
        self._apply = apply
        self._server: _Server | None = None
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Listen and serve.

        Raises:
            OSError: The address cannot be had.
        """
        self._server = _Server(self._address, self._apply)
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.05,), name="fault-port"
        )
        self._thread.start()

    def close(self) -> None:
        """Stop serving; safe twice."""
        if self._server is not None and self._thread is not None:
            self._server.shutdown()
            self._server.server_close()
            self._thread.join()
            self._server = self._thread = None


class _Server(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], apply: Apply) -> None:
        self.apply = apply
        super().__init__(address, _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that goes before it is answered is no error."""
        logger.debug("client %s: %s", client_address, sys.exception())


class _Handler(socketserver.StreamRequestHandler):
    server: _Server
    timeout = 30.0

    def handle(self) -> None:
        while line := self.rfile.readline(_LONGEST):
            reply = answer(self.server.apply, line.decode(errors="replace"))
            self.wfile.write(reply.encode() + b"\n")
