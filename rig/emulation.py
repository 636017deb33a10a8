"""What the emulators of the rig have in common: one World, one way to start, one way to end.

An emulator process prints `ready <name> <address>` when it listens, serves until SIGTERM, SIGINT
or, with --until-stdin-closes, until whoever started it is gone, and says how many ticks it missed.
"""

from __future__ import annotations

import argparse
import ipaddress
import logging
import os
import signal
import socketserver
import sys
import threading
from http.server import HTTPServer
from pathlib import Path
from typing import Protocol

import numpy as np

from rig.faultport import Apply, FaultPort
from rig.latest import WORLD_STATE
from rig.realtime import DEVICE_PRIORITY, be_punctual
from rig.shared import LatestRecord

UNTOUCHED_DEPTH = -0.01
"""Depth served before the World's first state: the indenter well above the surface [m]."""


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
        self._path = path
        self._record: LatestRecord | None = None
        self._untouched: np.void = np.zeros(1, WORLD_STATE)[0]
        self._untouched["depth"] = UNTOUCHED_DEPTH
        self._count = 0
        self._state: np.void = self._untouched

    def state(self) -> tuple[int, np.void]:
        """Number of the newest record (0: untouched so far) and the record."""
        if self._record is None:
            if self._path is None or not self._path.exists():
                return 0, self._untouched
            self._record = LatestRecord.attach(self._path, WORLD_STATE)
        count = self._record.count
        if count != self._count:
            state = self._record.read()
            if state is not None:
                self._count, self._state = count, state
        return self._count, self._state

    def close(self) -> None:
        """Let go of the file; safe twice."""
        if self._record is not None:
            self._record.close()
            self._record = None


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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options every emulator has."""
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


def fault_port(args: argparse.Namespace, apply: Apply) -> FaultPort | None:
    """The fault port that --host and --fault-port ask for; None without --fault-port.

    Args:
        args: What `add_arguments` parsed.
        apply: What a request does, `rig.disturbance.Disturbance.inject` for most devices.
    """
    if args.fault_port is None:
        return None
    return FaultPort(args.host, args.fault_port, apply)


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
        faults: Where faults are put in, see `fault_port`.

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
