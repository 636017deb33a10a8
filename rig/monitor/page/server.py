"""Process of the page: serves permitted clients and forwards their commands.

It shares only read-only records and one pipe with the recording. A slow client gets the newest
state whenever it is ready, never a queue of old ones. A client that reads nothing for long, sends
garbage or floods is disconnected. asyncio is used here, and only here in the rig, to handle many
idle connections in one thread.
"""

from __future__ import annotations

import asyncio
import http
import json
import logging
import os
import signal
import socket
import threading
from collections.abc import Awaitable, Callable
from dataclasses import asdict, replace
from functools import partial
from importlib import resources
from multiprocessing.connection import Connection
from typing import Any
from urllib.parse import unquote, urlsplit

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from recorder.command_line.options import next_command
from rig.core.clock import SECOND_NS, Clock, SystemClock
from rig.monitor.page.access import AccessPolicy
from rig.monitor.page.live_state import TRACE_RATE_HZ, TRACE_SECONDS, LiveState
from rig.monitor.page.messages import COMMANDS, ENDED, LETTERS, PageJob, Snapshot
from rig.monitor.page.quality import LiveQuality, Quality

# HTTP part: a few known files, and the headers that protect them from other sites.

# Path of the WebSocket.
LIVE = "/live"

FILES = {
    "/": ("page.html", "text/html; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/traces.js": ("traces.js", "text/javascript; charset=utf-8"),
    "/map.js": ("map.js", "text/javascript; charset=utf-8"),
    "/taxels.js": ("taxels.js", "text/javascript; charset=utf-8"),
    "/tools.js": ("tools.js", "text/javascript; charset=utf-8"),
    "/theme.js": ("theme.js", "text/javascript; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
}


class Site:
    """Answers all requests except those for the WebSocket, which it accepts or rejects.

    The files are read once, here: no path sent by a client ever reaches the disk.

    Args:
        access: Access policy.
        files: File and type of content of each path.
    """

    def __init__(self, access: AccessPolicy, files: dict[str, tuple[str, str]] = FILES) -> None:
        self._access = access
        folder = resources.files("rig.monitor.page") / "static"
        self._files = {
            path: ((folder / name).read_bytes(), kind) for path, (name, kind) in files.items()
        }

    def answer(self, request: Request, *, full: bool) -> Response | None:
        """Return the response, or None if the WebSocket may be opened.

        Args:
            request: Request of the client.
            full: True if the limit of watchers is reached.
        """
        host = single_header(request.headers, "Host")
        if not self._access.knows_host(host):
            return text_of(http.HTTPStatus.FORBIDDEN, "This name is not one of this bench's.\n")
        cookies = single_header(request.headers, "Cookie")
        try:
            path = unquote(urlsplit(request.path).path)
        except ValueError:
            return text_of(http.HTTPStatus.BAD_REQUEST, "This is not a valid address.\n")
        if path == LIVE:
            return self._refuse_live(request, host, cookies, full=full)
        if not self._access.may_open(request.path, cookies):
            return text_of(
                http.HTTPStatus.FORBIDDEN,
                "This page requires the token in the address that the collection printed.\n",
            )
        if path not in self._files:
            return text_of(http.HTTPStatus.NOT_FOUND, "There is no such page.\n")
        body, kind = self._files[path]
        headers = headers_of(kind, len(body), host or "")
        if path == "/":
            headers["Set-Cookie"] = self._access.set_cookie
        return Response(http.HTTPStatus.OK, "OK", headers, body)

    def _refuse_live(
        self, request: Request, host: str | None, cookies: str | None, *, full: bool
    ) -> Response | None:
        if not self._access.same_origin(single_header(request.headers, "Origin"), host):
            return text_of(http.HTTPStatus.FORBIDDEN, "Another site's page may not watch.\n")
        if not self._access.has_cookie(cookies):
            return text_of(http.HTTPStatus.FORBIDDEN, "Open the page first; it brings the token.\n")
        if full:
            return text_of(http.HTTPStatus.SERVICE_UNAVAILABLE, "Enough people are watching.\n")
        return None


def single_header(headers: Headers, name: str) -> str | None:
    """Return a header that was sent once, else None."""
    values = headers.get_all(name)
    return values[0] if len(values) == 1 else None


def text_of(status: http.HTTPStatus, text: str) -> Response:
    """Return a response of plain text."""
    body = text.encode()
    headers = headers_of("text/plain; charset=utf-8", len(body), "")
    return Response(status, status.phrase, headers, body)


def headers_of(kind: str, length: int, host: str) -> Headers:
    """Return the headers of a response, which keep other sites out."""
    # Older tablets do not count ws: as 'self'. The host was checked before it is repeated here.
    live = f" ws://{host}" if host else ""
    return Headers(
        {
            "Content-Type": kind,
            "Content-Length": str(length),
            "Connection": "close",
            "Cache-Control": "no-store",
            "Content-Security-Policy": (
                "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
                f"connect-src 'self'{live}; base-uri 'none'; form-action 'none'; "
                "frame-ancestors 'none'"
            ),
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
        }
    )


# Open pages at a time.
MAX_WATCHERS = 8
# TCP connections at a time, in any state.
MAX_CONNECTIONS = 48
# Longest message of a client [bytes]; a command has 20.
MAX_MESSAGE = 512
# Messages of one client in MESSAGE_WINDOW.
MAX_MESSAGES = 20
MESSAGE_WINDOW = 5.0
# Invalid messages after which a client is disconnected.
MAX_NONSENSE = 5
HANDSHAKE_TIMEOUT = 5.0
STATE_PERIOD = 0.1
# Interval between judgements of the quality [s].
QUALITY_PERIOD = 0.5
# Time for delivering the final state [s]; the process ends sooner if all clients have it.
LINGER = 3.0
# Send buffer of the kernel per client [bytes]; small, because its content is outdated on arrival.
_BUFFER = 64 * 1024
_LOG_LINES = 100

# Silences the library's log of every request with its address, which may contain the token.
_quiet = logging.getLogger("rig.monitor.page.wire")
_quiet.addHandler(logging.NullHandler())
_quiet.propagate = False


class _Connection(ServerConnection):
    """Connection of a client, with a small buffer.

    If there are too many, the oldest one that has not sent its request is closed: a browser sends
    it at once, and connections that stay silent cannot keep people out.

    Args:
        *arguments: Of `ServerConnection`.
        silent: Connections of the server, oldest first; True if the request has not arrived.
        **settings: Of `ServerConnection`.
    """

    def __init__(self, *arguments: Any, silent: dict[_Connection, bool], **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self._silent = silent

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._silent[self] = True
        if len(self._silent) > MAX_CONNECTIONS:
            oldest = next(each for each, silent in self._silent.items() if silent)
            del self._silent[oldest]
            oldest.transport.abort()
            if oldest is self:
                return
        raw = transport.get_extra_info("socket")
        if raw is not None:
            raw.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
            raw.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def connection_lost(self, exc: Exception | None) -> None:
        self._silent.pop(self, None)
        super().connection_lost(exc)

    def spoke(self) -> None:
        """Note that the request of the client has arrived."""
        if self in self._silent:
            self._silent[self] = False


def spoke(connection: ServerConnection) -> None:
    """Note that the request of a client has arrived."""
    if isinstance(connection, _Connection):
        connection.spoke()


async def listen(
    access: AccessPolicy,
    serve_client: Callable[[ServerConnection], Awaitable[None]],
    on_request: Callable[[ServerConnection, Request], Any],
    *,
    handshake_timeout: float = HANDSHAKE_TIMEOUT,
    max_size: int = MAX_MESSAGE,
) -> Server:
    """Return a server with the limits of this module.

    Args:
        access: Address to listen on.
        serve_client: Serves an open WebSocket.
        on_request: Answers a request, or returns None to open a WebSocket.
        handshake_timeout: Longest time from connection to answer [s].
        max_size: Longest message of a client [bytes].

    Raises:
        OSError: The address cannot be used.
    """
    connection: Any = partial(_Connection, silent={})
    return await serve(
        serve_client,
        access.host,
        access.port,
        process_request=on_request,
        create_connection=connection,
        compression=None,
        server_header=None,
        open_timeout=handshake_timeout,
        ping_interval=5.0,
        ping_timeout=10.0,
        close_timeout=1.0,
        max_size=max_size,
        max_queue=4,
        write_limit=_BUFFER,
        logger=_quiet,
    )


class PageServer:
    """State and clients of the page.

    Args:
        job: Settings of the page.
        pipe: Connection to the collecting process.
        clock: Clock.
    """

    def __init__(self, job: PageJob, pipe: Connection, clock: Clock) -> None:
        self._job = job
        self._pipe = pipe
        self._clock = clock
        self._look = LiveState(job.bench, job.folder, job.session, clock.now_ns())
        self._site = Site(job.access)
        self._snapshot = Snapshot(outcomes=LETTERS["open"] * len(job.spots))
        self._quality: list[Quality] = []
        self._log: list[str] = []
        self._logged = 0
        self._watchers: set[ServerConnection] = set()
        self._refused = 0
        self._ended = asyncio.Event()

    async def run(self) -> None:
        """Serve until the collection has ended and all clients have the final state."""
        access = self._job.access
        try:
            server = await listen(access, self._serve, self._on_request)
        except OSError as error:
            self._pipe.send(("failed", f"{access.host}:{access.port}: {error.strerror or error}"))
            return
        port = server.sockets[0].getsockname()[1]
        self._site = Site(replace(access, port=port))
        loop = asyncio.get_running_loop()
        loop.add_reader(self._pipe.fileno(), self._hear)
        self._pipe.send(("ready", port))
        threading.Thread(target=self._judge, name="quality", daemon=True).start()
        sampling = asyncio.create_task(self._sample())
        try:
            await self._ended.wait()
            deadline_ns = self._clock.now_ns() + round(LINGER * SECOND_NS)
            while self._watchers and self._clock.now_ns() < deadline_ns:
                await asyncio.sleep(STATE_PERIOD / 2)
        finally:
            loop.remove_reader(self._pipe.fileno())
            sampling.cancel()
            for connection in server.all_connections:
                connection.transport.abort()
            server.close()
            await server.wait_closed()
            self._look.close()

    def _hear(self) -> None:
        """Receive snapshots of the collecting process; only the newest counts."""
        try:
            while self._pipe.poll():
                snapshot: Snapshot = self._pipe.recv()
                self._snapshot = snapshot
                self._log += snapshot.log
                self._logged += len(snapshot.log)
                del self._log[:-_LOG_LINES]
        except (EOFError, OSError):
            asyncio.get_running_loop().remove_reader(self._pipe.fileno())
            if self._snapshot.status not in ENDED:
                self._snapshot = Snapshot(
                    "gone",
                    f"the collecting process is gone; recover {self._job.session} with: "
                    f"{next_command('session', 'recover', self._job.session)}",
                    outcomes=self._snapshot.outcomes,
                )
        if self._snapshot.status in ENDED:
            self._ended.set()

    async def _sample(self) -> None:
        while True:
            self._look.sample()
            await asyncio.sleep(1 / TRACE_RATE_HZ)

    def _judge(self) -> None:
        """Judge the quality until the process ends, in a thread: clients need not wait for it."""
        job = self._job
        try:
            live = LiveQuality(job.bench, job.session, job.clearance, self._clock.now_ns())
            while True:
                self._quality = live.look()
                self._clock.sleep_until(self._clock.now_ns() + round(QUALITY_PERIOD * SECOND_NS))
        except Exception as error:
            # A list that no longer changes would look like that of a healthy recording.
            text = f"not judged any more: {type(error).__name__}: {error}"
            self._quality = [Quality("quality", "fault", text)]
            raise

    def _on_request(self, connection: ServerConnection, request: Request) -> Response | None:
        spoke(connection)
        full = len(self._watchers) >= MAX_WATCHERS
        response = self._site.answer(request, full=full)
        if response is not None and response.status_code in (403, 503):
            self._refused += 1
        return response

    async def _serve(self, client: ServerConnection) -> None:
        if len(self._watchers) >= MAX_WATCHERS:
            await client.close(1013, "enough people are watching")
            return
        self._watchers.add(client)
        listening = asyncio.create_task(self._listen_to(client))
        try:
            await self._show(client, listening)
        except ConnectionClosed:
            pass
        except TimeoutError:
            # It does not read, so no close frame would arrive.
            client.transport.abort()
        finally:
            self._watchers.discard(client)
            listening.cancel()

    async def _show(self, client: ServerConnection, listening: asyncio.Task[str]) -> None:
        await self._send(client, json.dumps(self._hello()))
        traced = dict.fromkeys(self._look.traces, 0)
        logged, turn = 0, 0
        sent = dict.fromkeys(self._look.pictures, -1)
        while True:
            ended = self._ended.is_set()
            state = self._state(traced, logged)
            traced = {name: trace.total for name, trace in self._look.traces.items()}
            logged = self._logged
            state["images"] = self._look.images()
            await self._send(client, json.dumps(state))
            turn += 1
            for name in _in_turn(list(sent), turn):
                picture = self._look.pictures[name]
                if picture.jpeg is not None and picture.row != sent[name]:
                    sent[name] = picture.row
                    number = list(self._look.kinds).index(name)
                    await self._send(client, bytes([number]) + picture.jpeg)
            if ended:
                await client.close(1001, "the collection ended")
                return
            done, _ = await asyncio.wait({listening}, timeout=STATE_PERIOD)
            if done:
                if reason := listening.result():
                    await client.close(1008, reason)
                return

    async def _send(self, client: ServerConnection, message: str | bytes) -> None:
        async with asyncio.timeout(self._job.patience):
            await client.send(message)

    async def _listen_to(self, client: ServerConnection) -> str:
        """Forward commands until the client leaves; return why it is disconnected, or ''."""
        received: list[int] = []
        nonsense = 0
        try:
            async for message in client:
                now_ns = self._clock.now_ns()
                received = [t for t in received if now_ns - t < MESSAGE_WINDOW * SECOND_NS]
                received.append(now_ns)
                if len(received) > MAX_MESSAGES:
                    self._refused += 1
                    return "too many messages"
                command = parse_command(message)
                if command is None:
                    self._refused += 1
                    nonsense += 1
                    if nonsense >= MAX_NONSENSE:
                        return "invalid command"
                elif not self._ended.is_set():
                    self._pipe.send(command)
        except (ConnectionClosed, OSError):
            pass
        return ""

    def _hello(self) -> dict[str, Any]:
        """Return the data that stay constant during the collection."""
        job = self._job
        points = {spot.point: [1e3 * spot.x, 1e3 * spot.y] for spot in job.spots}
        return {
            "kind": "hello",
            "sensor": job.bench.sensor,
            "indenter": job.indenter,
            "mock": job.bench.mock,
            "session": job.session.name,
            **self._look.shown(),
            "points": [{"point": point, "at": place} for point, place in points.items()],
            "targets": [[s.point, round(1e3 * s.depth, 4), s.direction] for s in job.spots],
            "directions": job.directions,
            "limits": self._look.limits(),
            "seconds": TRACE_SECONDS,
        }

    def _state(self, traced: dict[str, int], logged: int) -> dict[str, Any]:
        """Return the changing data, with the points and log lines that are new to the client."""
        now = self._snapshot
        new = min(self._logged - logged, len(self._log))
        return {
            "kind": "state",
            "status": now.status,
            "reason": now.reason,
            "target": now.target,
            "phase": now.phase,
            "outcomes": now.outcomes,
            "left": now.left,
            "elapsed": now.elapsed,
            "paused_by": list(now.paused_by),
            "streams": self._look.streams(self._clock.now_ns()),
            "forces": self._look.forces(),
            "tips": self._look.tips(),
            "taxels": self._look.taxels(),
            "quality": [asdict(each) for each in self._quality],
            "traces": {name: t.since(traced[name]) for name, t in self._look.traces.items()},
            "log": self._log[len(self._log) - new :],
            "watchers": len(self._watchers),
            "refused": self._refused,
        }


def _in_turn(cameras: list[str], turn: int) -> list[str]:
    """Return the cameras whose image is sent now: the first, and one of the others in turn.

    So the data sent in one period do not grow with the number of cameras.
    """
    first, others = cameras[:1], cameras[1:]
    return first + others[turn % len(others) :][:1] if others else first


def parse_command(message: str | bytes) -> str | None:
    """Return the command in a client's message, or None for anything else."""
    try:
        content = json.loads(message)
    except (ValueError, RecursionError):
        return None
    if not isinstance(content, dict) or set(content) != {"command"}:
        return None
    command = content["command"]
    return command if isinstance(command, str) and command in COMMANDS else None


def run_page(job: PageJob, pipe: Connection) -> None:
    """Run the process; `pipe` is its end of the connection."""
    # Ctrl-C is handled by the collecting process, which ends this one through the pipe.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    # Recording has priority over all clients.
    os.nice(10)
    try:
        asyncio.run(PageServer(job, pipe, SystemClock()).run())
    finally:
        pipe.close()
