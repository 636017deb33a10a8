"""Common parts of the emulators: settings, shared World and fault injection.

The module of an emulator has a function `emulate`, which `rig.mock.emulate` calls: it takes
settings and a clock, and returns the emulator, not yet started.
"""

from __future__ import annotations

import ipaddress
import json
import logging
import os
import socket
import socketserver
import sys
import threading
import tty
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import chain, islice
from pathlib import Path
from typing import Any, Generic, TypeVar
from urllib.parse import SplitResult, urlsplit

import numpy as np

from rig.core.realtime import DEVICE_PRIORITY
from rig.core.samples import WORLD_STATE
from rig.core.shared_memory import AwaitedRecord

logger = logging.getLogger(__name__)

# What an emulator sends: bytes or text.
M = TypeVar("M")

# Port for injecting faults into a running emulator, used by `benchmarks faults` and the tests.
#
# One JSON object per line, {"fault": NAME, ...}. Each is answered by one line: {"ok": true, ...}
# with the device's state, or {"ok": false, "error": TEXT}. The port is separate from the device's
# own protocol, so it answers while the device is unplugged or frozen, and it is open only on the
# emulator's own loopback address.

# Called with the name of a fault and its values; returns the device's state.
#
# Raises ValueError, KeyError or TypeError if the fault is unknown or a value is missing.
Apply = Callable[..., dict[str, Any]]

# Late records that a gauge's emulator sends at once; after a longer stop the rest is lost, as in a
# full buffer.
LATE_MOST = 100

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
    """Inject a fault through an emulator's fault port and return its device's state."""
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


class FaultPort(socketserver.ThreadingTCPServer):
    """Serves the fault port of one emulator in its own threads, until it is closed."""

    allow_reuse_address = True
    daemon_threads = True
    block_on_close = False

    def __init__(self, host: str, port: int, apply: Apply) -> None:
        self.apply = apply
        super().__init__((host, port), _Handler)
        self._thread = threading.Thread(target=self.serve_forever, args=(0.05,), name="fault-port")
        self._thread.start()

    def close(self) -> None:
        """Stop serving; may be called twice."""
        self.shutdown()
        self.server_close()
        self._thread.join()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log a client that disconnects before its answer; this is no error."""
        logger.debug("client %s: %s", client_address, sys.exception())


class _Handler(socketserver.StreamRequestHandler):
    server: FaultPort
    timeout = 30.0

    def handle(self) -> None:
        while line := self.rfile.readline(_LONGEST):
            reply = answer(self.server.apply, line.decode(errors="replace"))
            self.wfile.write(reply.encode() + b"\n")


# Depth served before the World's first state: the indenter well above the surface [m].
NO_CONTACT_DEPTH = -0.01


class SharedWorld(AwaitedRecord):
    """World that another process publishes, maybe later; without a file nothing touches it."""

    def __init__(self, path: Path | None) -> None:
        super().__init__(path, WORLD_STATE)
        self._state: np.void = np.zeros(1, WORLD_STATE)[0]
        self._state["depth"] = NO_CONTACT_DEPTH
        self._newest = 0

    def state(self) -> tuple[int, np.void]:
        """Return the number of the newest record (0: no contact so far) and the record."""
        count = self.count
        if count != self._newest and (state := self.read()) is not None:
            self._newest, self._state = count, state
        return self._newest, self._state


class DeviceServer(ThreadingHTTPServer):
    """HTTP server of an emulated device, without a host name; unplugged, it rejects all clients."""

    daemon_threads = True

    def __init__(
        self, address: tuple[str, int], handler: type[DeviceHandler], emulator: Any
    ) -> None:
        self.emulator = emulator
        """Emulator of the device, with its `faults`."""
        super().__init__(address, handler)

    def server_bind(self) -> None:
        """Bind without looking up the host name, which may take seconds."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Reject every client while the device is unplugged."""
        return not self.emulator.faults.unplugged

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log at debug level: a client that leaves before its answer is no error."""
        logger.debug("client %s: %s", client_address, sys.exception())


class DeviceHandler(BaseHTTPRequestHandler):
    """Handler of requests to an emulated device."""

    server: DeviceServer

    def do_GET(self) -> None:
        """Serve a request."""
        self.get(urlsplit(self.path))

    def get(self, url: SplitResult) -> None:
        """Serve the resource of a URL."""
        raise NotImplementedError

    def answer(self, content: bytes, kind: str) -> None:
        """Send a page of MIME type `kind`."""
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing: stdout is reserved for the ready line."""


class Emulator:
    """Base of the emulators, which serve in threads until they are closed."""

    missed = 0
    """Number of ticks that were late and skipped."""

    def __init__(self) -> None:
        self._ending = threading.Event()
        self._threads: list[threading.Thread] = []

    @property
    def address(self) -> str:
        """Address for drivers to connect to, if it is not reached through shared memory alone."""
        return "shared memory"

    def start(self) -> None:
        """Listen and serve; return when clients can connect."""
        raise NotImplementedError

    @property
    def closing(self) -> bool:
        """True once `close` was called."""
        return self._ending.is_set()

    def close(self) -> None:
        """Stop serving; may be called twice."""
        self._ending.set()
        self._disconnect()
        for thread in self._threads:
            thread.join()
        self._threads = []
        self._release()

    def _run_threads(self, *targets: Callable[[], object]) -> None:
        self._threads = [threading.Thread(target=target) for target in targets]
        for thread in self._threads:
            thread.start()

    def _disconnect(self) -> None:
        """Wake the threads, which end because `_ending` is set; may be called twice."""

    def _release(self) -> None:
        """Release everything that the threads used; may be called twice."""


class Newest(Generic[M]):
    """The newest `kept` messages, for clients that each take them in order.

    A client that falls behind misses those before.
    """

    def __init__(self, kept: int, ending: threading.Event) -> None:
        self._messages: deque[tuple[M, ...]] = deque(maxlen=kept)
        self._ending = ending
        self._changed = threading.Condition()
        self.count = 0
        """Messages published so far."""

    def publish(self, parts: Iterable[M]) -> None:
        """Publish one message; its parts are what faults make of it."""
        sent = tuple(parts)
        with self._changed:
            self.count += 1
            self._messages.append(sent)
            self._changed.notify_all()

    def newer_than(self, number: int) -> tuple[int, list[M]]:
        """Wait for a message after that of this number; return the newest number and the parts.

        At the end of the emulator there are none.
        """
        with self._changed:
            self._changed.wait_for(lambda: self.count > number or self._ending.is_set())
            if self._ending.is_set():
                return self.count, []
            behind = min(self.count - number, len(self._messages))
            newer = islice(self._messages, len(self._messages) - behind, None)
            return self.count, list(chain.from_iterable(newer))

    def wake(self) -> None:
        """Wake the waiting clients, because the emulator closes."""
        with self._changed:
            self._changed.notify_all()


class Pty:
    """Pseudo terminal with a link to it, in place of a serial port."""

    def __init__(self, link: Path) -> None:
        if link.exists() and not link.is_symlink():
            raise FileExistsError(f"{link}: exists, and is no link")
        self._link = link
        # Both ends stay open here: clients may come and go, and a pty that nobody has open cannot
        # be read.
        self.fd, self._theirs = os.openpty()
        """Descriptor of the device's end."""
        for end in (self.fd, self._theirs):
            tty.setraw(end)
        fresh = link.with_name(f"{link.name}.new")
        try:
            fresh.unlink(missing_ok=True)
            fresh.symlink_to(os.ttyname(self._theirs))
            fresh.replace(link)
        except OSError:
            self.close()
            raise

    def close(self) -> None:
        """Close both ends and remove the link."""
        for end in (self.fd, self._theirs):
            os.close(end)
        self._link.unlink(missing_ok=True)


class PtyEmulator(Emulator):
    """Base of the emulators on a pty: one thread, `_serve`, receives and sends."""

    def __init__(self, link: Path) -> None:
        super().__init__()
        self._link = link
        self._pty: Pty | None = None

    @property
    def address(self) -> str:
        """Link for a driver to open."""
        return str(self._link)

    def start(self) -> None:
        """Create the pty and the link to it, and serve."""
        self._pty = Pty(self._link)
        self._fd = self._pty.fd
        os.set_blocking(self._fd, False)
        self._run_threads(self._serve)

    def _serve(self) -> None:
        raise NotImplementedError

    def _release(self) -> None:
        if self._pty is not None:
            self._pty.close()
            self._pty = None

    def _send(self, content: bytes) -> None:
        try:
            os.write(self._fd, content)
        except BlockingIOError:
            # Nobody reads it: the line has no handshake, the bytes are lost.
            logger.debug("%d bytes lost: nobody reads", len(content))


@dataclass(frozen=True, slots=True, kw_only=True)
class EmulatorConfig:
    """Settings common to all emulators of devices.

    Their `device` has the settings of the device in a bench file: its ports, rates and scales. The
    emulator listens on `host`, whichever host an address there has.
    """

    host: str = "127.0.0.1"
    """Loopback address to listen on."""
    world: Path | None = None
    """File of the World's states; None: nothing ever touches the sensor."""
    seed: int = 0
    """Seed of noise and garbage."""
    fault_port: int | None = None
    """Port for injecting faults; None: none."""

    def __post_init__(self) -> None:
        require_loopback(self.host)


def require_loopback(host: str) -> None:
    """Reject an address that other machines can reach, as a lab's device can be."""
    try:
        if ipaddress.ip_address(host).is_loopback:
            return
    except ValueError:
        pass
    raise ValueError(f"host: found {host!r}; allowed: a loopback address, 127.x.y.z")


@dataclass(frozen=True, slots=True)
class Served:
    """Emulator to be served, and how."""

    name: str
    """Name in the ready line."""
    emulator: Emulator
    """Not yet started."""
    apply: Apply | None = None
    """Handler of requests at the fault port; None: no fault port."""
    priority: int = DEVICE_PRIORITY
    """Requested real-time priority."""
    conclude: Callable[[], int] | None = None
    """Called at the end, to print a summary; returns the exit code. None: nothing, and 0."""
