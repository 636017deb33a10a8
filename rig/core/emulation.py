"""What the emulators of the rig have in common: one World, one way to start, one way to end.

An emulator process prints `ready <name> <address>` when it listens, serves until SIGTERM, SIGINT
or, with --until-stdin-closes, until whoever started it is gone, and says how many ticks it missed.
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
from rig.core.realtime import DEVICE_PRIORITY, be_punctual
from rig.core.samples import WORLD_STATE
from rig.core.shared_memory import AwaitedRecord

logger = logging.getLogger(__name__)

# The port through which faults are put into a running emulator: `make faults`, and the tests.
#
# One JSON object a line, {"fault": NAME, ...}, each answered by one: {"ok": true, ...} with how the
# device is, or {"ok": false, "error": TEXT}. It lies beside the device's own protocol, so that it
# answers while the device is unplugged or frozen, and only on the emulator's own loopback address.

# Fault port of each device of a mock bench, at the bench's own loopback address.
PORTS = {
    "arm": 31000,
    "force": 31001,
    "camera": 31002,
    "taxels": 31003,
    "gripper": 31004,
    "pedal": 31005,
    "spacemouse": 31006,
}

# Called with the name of the fault and its values; tells how the device is.
#
# It raises ValueError, KeyError or TypeError when it knows no such fault or misses a value.
Apply = Callable[..., dict[str, Any]]

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


# Depth served before the World's first state: the indenter well above the surface [m].
UNTOUCHED_DEPTH = -0.01


class World(Protocol):
    """Where an emulator gets what its device would measure."""

    def state(self) -> tuple[int, np.void]:
        """Number of the newest WORLD_STATE record, 0 before the first, and the record."""


class SharedWorld:
    """The World that another process publishes in a `LatestRecord` file.

    Args:
        path: The file; it may appear later. None: nothing ever touches the sensor.
    """

    def __init__(self, path: Path | None) -> None:
        self._record = AwaitedRecord(path, WORLD_STATE)
        self._state: np.void = np.zeros(1, WORLD_STATE)[0]
        self._state["depth"] = UNTOUCHED_DEPTH
        self._count = 0

    def state(self) -> tuple[int, np.void]:
        """Number of the newest record (0: untouched so far) and the record."""
        count = self._record.count
        if count != self._count:
            state = self._record.read()
            if state is not None:
                self._count, self._state = count, state
        return self._count, self._state

    def close(self) -> None:
        """Let go of the file; safe twice."""
        self._record.close()


class NamelessServer(HTTPServer):
    """An HTTP server of an emulated device, which nobody knows by name."""

    def server_bind(self) -> None:
        """Bind without the look-up of a host name, which may take seconds."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]


class Emulator(Protocol):
    """An emulated device that serves in threads of its own."""

    @property
    def address(self) -> str:
        """What a driver connects to."""

    @property
    def missed(self) -> int:
        """Ticks that came too late and were skipped."""

    def start(self) -> None:
        """Listen and serve; returns when clients can connect."""

    def close(self) -> None:
        """Stop serving; safe twice."""


def loopback(text: str) -> str:
    """An address that only this machine can reach: what drives an emulator, drives no lab.

    Raises:
        argparse.ArgumentTypeError: Any other, or a name.
    """
    try:
        if ipaddress.ip_address(text).is_loopback:
            return text
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"found {text!r}; allowed: a loopback address, 127.x.y.z")


def emulator_parser(prog: str, doc: str | None) -> argparse.ArgumentParser:
    """A parser with the options every emulator has.

    Args:
        prog: How the process is called.
        doc: Docstring of its module.
    """
    parser = argparse.ArgumentParser(prog=prog, description=doc)
    parser.add_argument(
        "--host",
        type=loopback,
        default="127.0.0.1",
        help="loopback address to listen on (%(default)s)",
    )
    parser.add_argument("--world", type=Path, metavar="PATH", help="file of the World's states")
    parser.add_argument("--seed", type=int, default=0, help="of the noise (%(default)s)")
    parser.add_argument(
        "--fault-port", type=int, metavar="PORT", help="take faults to inject there (default: none)"
    )
    parser.add_argument(
        "--until-stdin-closes",
        action="store_true",
        help="end when whoever started me does",
    )
    return parser


@dataclass(frozen=True, slots=True)
class Served:
    """What the process of an emulator serves."""

    name: str
    """What it is called in its one line of output."""
    emulator: Emulator
    """Not yet started."""
    apply: Apply | None = None
    """What a request at the fault port does; None: it takes no faults there."""
    priority: int = DEVICE_PRIORITY
    """Of the real-time scheduling that is asked for."""


def run_emulator(
    parser: argparse.ArgumentParser,
    make: Callable[[argparse.Namespace, SharedWorld], Served],
    argv: Sequence[str] | None = None,
) -> int:
    """The body of an emulator's `main`: read the options, make it, serve until told to end.

    Args:
        parser: Of `emulator_parser`, with the emulator's own options.
        make: Makes what is served, of the options and the World that --world names. A ConfigError
            of it is the message with which the process ends at once.
        argv: Options; None: those of this process.

    Returns:
        Exit code: 0, or 2 when an option is wrong or the address cannot be listened on.
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
    """Run `emulator` until the process is told to end.

    Args:
        name: What it is called in its one line of output.
        emulator: What is served.
        until_stdin_closes: End when whoever started this process is gone.
        priority: Of the real-time scheduling that is asked for.
        faults: Where faults are put in.

    Returns:
        Exit code: 0, or 2 when the address cannot be listened on.
    """
    be_punctual(priority)
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
        # Short waits: a signal handler runs only between two of them.
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
