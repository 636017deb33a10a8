"""Common parts of the emulators: shared World, options, start, fault injection and shutdown.

An emulator process prints `ready <name> <address>` once it listens. It serves until SIGTERM or
SIGINT, or with --until-stdin-closes until its parent exits, then prints the number of ticks missed.
"""

from __future__ import annotations

import argparse
import ipaddress
import json
import logging
import os
import signal
import socket
import socketserver
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from http.server import HTTPServer
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from rig.core.errors import ConfigError
from rig.core.realtime import DEVICE_PRIORITY, enable_realtime
from rig.core.samples import WORLD_STATE
from rig.core.shared_memory import AwaitedRecord

logger = logging.getLogger(__name__)

# Port for injecting faults into a running emulator, used by `make faults` and the tests.
#
# One JSON object per line, {"fault": NAME, ...}. Each is answered by one line: {"ok": true, ...}
# with the device's state, or {"ok": false, "error": TEXT}. The port is separate from the device's
# own protocol, so it answers while the device is unplugged or frozen, and it is open only on the
# emulator's own loopback address.

# Fault port of each device of a mock bench, at the bench's loopback address.
PORTS = {
    "arm": 31000,
    "force": 31001,
    "camera": 31002,
    "taxels": 31003,
    "gripper": 31004,
    "pedal": 31005,
    "spacemouse": 31006,
}

# Called with the name of a fault and its values; returns the device's state.
#
# Raises ValueError, KeyError or TypeError if the fault is unknown or a value is missing.
Apply = Callable[..., dict[str, Any]]

# Longest request line [bytes].
_LONGEST = 1 << 16


def answer(apply: Apply, line: str) -> str:
    """Return the reply to one request line."""
    try:
        request = json.loads(line)
        return json.dumps({"ok": True, **apply(**request)})
    except (ValueError, KeyError, TypeError) as error:
        return json.dumps({"ok": False, "error": f"{type(error).__name__}: {error}"})


def inject(host: str, port: int, fault: str, **values: Any) -> dict[str, Any]:
    """Inject a fault through an emulator's fault port and return its device's state.

    Raises:
        OSError: No emulator listens there.
        ValueError: The emulator does not know the fault, or a value is missing.
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
    """Serves the fault port of one emulator in its own threads.

    Args:
        host: Loopback address.
        port: TCP port.
        apply: Handler of a request.
    """

    def __init__(self, host: str, port: int, apply: Apply) -> None:
        self._address = (host, port)
        self._apply = apply
        self._server: _Server | None = None
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Listen and serve.

        Raises:
            OSError: The address cannot be bound.
        """
        self._server = _Server(self._address, self._apply)
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.05,), name="fault-port"
        )
        self._thread.start()

    def close(self) -> None:
        """Stop serving; may be called twice."""
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
        """Log a client that disconnects before its answer; this is no error."""
        logger.debug("client %s: %s", client_address, sys.exception())


class _Handler(socketserver.StreamRequestHandler):
    server: _Server
    timeout = 30.0

    def handle(self) -> None:
        while line := self.rfile.readline(_LONGEST):
            reply = answer(self.server.apply, line.decode(errors="replace"))
            self.wfile.write(reply.encode() + b"\n")


# Depth served before the World's first state: the indenter well above the surface [m].
UNTOUCHED_DEPTH = -0.01


class WorldReader(Protocol):
    """Source of the quantities that an emulated device measures."""

    def state(self) -> tuple[int, np.void]:
        """Return the newest WORLD_STATE record and its number, 0 before the first."""


class SharedWorld:
    """World published by another process in a `SharedLatest` file.

    Args:
        path: The file, which may be created later. None: nothing ever touches the sensor.
    """

    def __init__(self, path: Path | None) -> None:
        self._record = AwaitedRecord(path, WORLD_STATE)
        self._state: np.void = np.zeros(1, WORLD_STATE)[0]
        self._state["depth"] = UNTOUCHED_DEPTH
        self._count = 0

    def state(self) -> tuple[int, np.void]:
        """Return the number of the newest record (0: no contact so far) and the record."""
        count = self._record.count
        if count != self._count:
            state = self._record.read()
            if state is not None:
                self._count, self._state = count, state
        return self._count, self._state

    def close(self) -> None:
        """Release the file; may be called twice."""
        self._record.close()


class NamelessServer(HTTPServer):
    """HTTP server of an emulated device, without a host name."""

    def server_bind(self) -> None:
        """Bind without looking up the host name, which may take seconds."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]


class Emulator(Protocol):
    """Emulated device that serves in its own threads."""

    @property
    def address(self) -> str:
        """Address for drivers to connect to."""

    @property
    def missed(self) -> int:
        """Number of ticks that were late and skipped."""

    def start(self) -> None:
        """Listen and serve; return when clients can connect."""

    def close(self) -> None:
        """Stop serving; may be called twice."""


def loopback(text: str) -> str:
    """Return `text` if it is a loopback address, so emulator commands never reach a lab's devices.

    Raises:
        argparse.ArgumentTypeError: It is another address, or a name.
    """
    try:
        if ipaddress.ip_address(text).is_loopback:
            return text
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"found {text!r}; allowed: a loopback address, 127.x.y.z")


def emulator_parser(prog: str, doc: str | None) -> argparse.ArgumentParser:
    """Return a parser with the options common to all emulators.

    Args:
        prog: Program name for the usage line.
        doc: Docstring of the emulator's module.
    """
    parser = argparse.ArgumentParser(prog=prog, description=doc)
    parser.add_argument(
        "--host",
        type=loopback,
        default="127.0.0.1",
        help="loopback address to listen on (%(default)s)",
    )
    parser.add_argument("--world", type=Path, metavar="PATH", help="file of the World's states")
    parser.add_argument("--seed", type=int, default=0, help="seed of the noise (%(default)s)")
    parser.add_argument(
        "--fault-port", type=int, metavar="PORT", help="port for injecting faults (default: none)"
    )
    parser.add_argument(
        "--until-stdin-closes",
        action="store_true",
        help="exit when the parent process does",
    )
    return parser


@dataclass(frozen=True, slots=True)
class Served:
    """Emulator to be served, with its settings."""

    name: str
    """Name in the ready line."""
    emulator: Emulator
    """Not yet started."""
    apply: Apply | None = None
    """Handler of requests at the fault port; None: no fault port."""
    priority: int = DEVICE_PRIORITY
    """Requested real-time priority."""


def run_emulator(
    parser: argparse.ArgumentParser,
    make: Callable[[argparse.Namespace, SharedWorld], Served],
    argv: Sequence[str] | None = None,
) -> int:
    """Run an emulator's `main`: read the options, create the emulator, serve until stopped.

    Args:
        parser: Returned by `emulator_parser`, with the emulator's own options added.
        make: Creates the emulator from the options and the World of --world. If it raises
            ConfigError, the process ends with that message.
        argv: Options; None: those of this process.

    Returns:
        Exit code: 0, or 2 if an option is invalid or the address cannot be listened on.
    """
    args = parser.parse_args(argv)
    world = SharedWorld(args.world)
    try:
        served = make(args, world)
    except ConfigError as error:
        parser.error(str(error))
    faults = None
    if served.apply is not None and args.fault_port is not None:
        faults = FaultPort(args.host, args.fault_port, served.apply)
    try:
        return serve(
            served.name,
            served.emulator,
            until_stdin_closes=args.until_stdin_closes,
            priority=served.priority,
            faults=faults,
        )
    finally:
        world.close()


def serve(
    name: str,
    emulator: Emulator,
    *,
    until_stdin_closes: bool,
    priority: int = DEVICE_PRIORITY,
    faults: FaultPort | None = None,
) -> int:
    """Run `emulator` until the process is stopped.

    Args:
        name: Name in the ready line.
        emulator: Emulator to serve.
        until_stdin_closes: End when the parent process is gone.
        priority: Requested real-time priority.
        faults: Fault port to open.

    Returns:
        Exit code: 0, or 2 if the address cannot be listened on.
    """
    enable_realtime(priority)
    logging.basicConfig(stream=sys.stderr, format=f"{name}: %(message)s")
    ending = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: ending.set())
    if until_stdin_closes:
        threading.Thread(target=_watch_stdin, args=(ending,), daemon=True).start()
    try:
        emulator.start()
    except OSError as error:
        print(f"{name}: cannot listen on {emulator.address}: {error}", file=sys.stderr)
        return 2
    try:
        if faults is not None:
            faults.start()
    except OSError as error:
        emulator.close()
        print(f"{name}: cannot listen on its fault port: {error}", file=sys.stderr)
        return 2
    try:
        print(f"ready {name} {emulator.address}", flush=True)
        # Short waits, because signal handlers run only between two of them.
        while not ending.wait(0.2):
            pass
    finally:
        if faults is not None:
            faults.close()
        emulator.close()
        print(f"{name}: {emulator.missed} ticks missed", file=sys.stderr, flush=True)
    return 0


def _watch_stdin(ending: threading.Event) -> None:
    # os.read, not sys.stdin: a daemon thread must not hold the lock of a buffered stream at exit.
    while os.read(0, 4096):
        pass
    ending.set()
