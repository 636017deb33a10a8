"""The one server of the page: files, data of a lab, and a live view pushed to permitted clients.

It shares only read-only records and one pipe with a recording. A slow client gets the newest state
whenever it is ready, never a queue of old ones. A client that reads nothing for long, or floods, is
disconnected. Data of the lab are read in one thread, one request after the other. No request starts
a device: what has to be done at the bench is shown as a command to type there.
asyncio is used here, and only here in the rig, to handle many idle connections in one thread.
"""

import asyncio
import http
import json
import logging
import os
import signal
import socket
from collections import Counter, deque
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from typing import Any, Generic, TypeVar
from urllib.parse import unquote, urlsplit

from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from recorder.errors import SessionError
from rig.core.clock import SECOND_NS, Clock
from rig.core.errors import ConfigError
from rig.monitor.access import FORCES, AccessPolicy, Site, headers_of, single_header, text_of
from rig.monitor.lab import Folders, Lab

Item = TypeVar("Item")
# Rate at which a view reads the newest samples, for display only [Hz].
SAMPLE_RATE_HZ = 40.0


class Backlog(Generic[Item]):
    """The newest `most` items of a stream; each client gets those that it does not have."""

    def __init__(self, most: int) -> None:
        self._items: deque[Item] = deque(maxlen=most)
        self._total = 0

    def add(self, item: Item) -> None:
        """Add an item."""
        self._items.append(item)
        self._total += 1

    def clear(self) -> None:
        """Forget all items."""
        self._items.clear()

    def news(self, sent: Counter[str], name: str) -> list[Item]:
        """Return the items that a client does not have, and note under `name` that it has them."""
        new = min(self._total - sent[name], len(self._items))
        sent[name] = self._total
        return [self._items[k] for k in range(len(self._items) - new, len(self._items))]


class LiveView:
    """The live view of a page."""

    commands: tuple[str, ...] = ()
    """Commands that clients may send."""
    ended = False
    """True once the last state is known."""

    def hello(self) -> dict[str, Any]:
        """Return the constant data, with the name of the view as `live`."""
        raise NotImplementedError

    def news(self, sent: Counter[str], clients: Mapping[str, int]) -> list[dict[str, Any] | bytes]:
        """Return state and pictures for a client, noted in `sent`, with the counts of clients."""
        raise NotImplementedError

    def stream(self, sent: Counter[str]) -> list[dict[str, Any]]:
        """Return the forces that a program does not have, noted in `sent`."""
        return []

    def receive(self, message: Any) -> None:
        """Receive what the command has sent."""
        raise NotImplementedError

    def lose(self) -> None:
        """Receive that the command's process is gone."""
        raise NotImplementedError

    def start(self) -> None:
        """Start what runs beside the server."""

    def sample(self) -> None:
        """Read the newest samples; called at `SAMPLE_RATE_HZ`."""

    def close(self) -> None:
        """Release all files; may be called twice."""


# Path of the lab's data.
DATA = "/data/"
# Open pages at a time: of a live view, whose images each of them gets, and without one.
MAX_WATCHERS, MAX_READERS = 8, 32
# Longest message of a client [bytes]: the marks of a session.
MAX_MESSAGE = 8192
# Messages of one client in MESSAGE_WINDOW: each wakes the recording process.
MAX_MESSAGES = 20
MESSAGE_WINDOW = 5.0
# Longest time from connection to the end of the answer, by a page of low priority on a busy machine
# [s].
ANSWER_TIMEOUT = 120.0
STATE_PERIOD = 0.1
# Time for delivering the final state [s]; the process ends sooner if all clients have it.
LINGER = 3.0
# Time after which a client that reads nothing is disconnected [s].
PATIENCE = 5.0
# Send buffer of the kernel per client [bytes]; small, because its content is outdated on arrival.
_BUFFER = 64 * 1024
# A report brings its own style and pictures, and nothing else.
_REPORT_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox"

# Silences the library's log of every request with its address, which may contain the token.
_quiet = logging.getLogger("rig.monitor.wire")
_quiet.addHandler(logging.NullHandler())
_quiet.propagate = False


@dataclass(frozen=True, slots=True)
class Marks:
    """Targets of a session that a client marks to be recorded again."""

    session: str
    """Its path in the catalogue."""
    targets: tuple[int, ...]
    """Numbers of the targets, from 1."""


class PageServer:
    """The page: a lab, if it has folders, and a command's live view; a pipe or signal ends it."""

    def __init__(
        self,
        access: AccessPolicy,
        folders: Folders | None,
        clock: Clock,
        view: LiveView | None = None,
        pipe: Connection | None = None,
    ) -> None:
        self._access = access
        self._site = Site(access)
        self._lab = None if folders is None else Lab(folders, clock)
        self._clock = clock
        self._view = view
        self._pipe = pipe
        self._reader = ThreadPoolExecutor(1, "lab", initializer=os.nice, initargs=(5,))
        self._clients: set[ServerConnection] = set()
        self._most = MAX_READERS if view is None else MAX_WATCHERS
        self._refused = 0
        self._ended = asyncio.Event()
        self._news = asyncio.Event()

    async def run(self, ready: Callable[[int], None]) -> None:
        """Serve until a signal, or until the command has ended and all clients know it.

        `ready` is called with the port.
        """
        access = self._access
        try:
            server = await serve(
                self._serve,
                access.host,
                access.port,
                process_request=self._on_request,
                compression=None,
                server_header=None,
                open_timeout=ANSWER_TIMEOUT,
                ping_interval=5.0,
                ping_timeout=10.0,
                close_timeout=1.0,
                max_size=MAX_MESSAGE,
                max_queue=4,
                write_limit=_BUFFER,
                logger=_quiet,
            )
        except OSError as error:
            raise ConfigError(
                f"found {access.host}:{access.port}: {error.strerror or error}; "
                "allowed: a free port of this machine"
            ) from None
        port = server.sockets[0].getsockname()[1]
        self._access = replace(access, port=port)
        self._site = Site(self._access)
        loop = asyncio.get_running_loop()
        if self._pipe is not None and self._view is not None:
            loop.add_reader(self._pipe.fileno(), self._receive, self._pipe, self._view)
        else:
            for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGTERM, signal.SIGHUP):
                loop.add_signal_handler(number, self._ended.set)
        ready(port)
        sampling = asyncio.create_task(self._sample())
        try:
            await self._ended.wait()
            deadline_ns = self._clock.now_ns() + round(LINGER * SECOND_NS)
            while self._view and self._clients and self._clock.now_ns() < deadline_ns:
                await asyncio.sleep(STATE_PERIOD / 2)
        finally:
            if self._pipe is not None:
                loop.remove_reader(self._pipe.fileno())
            sampling.cancel()
            for connection in server.all_connections:
                connection.transport.abort()
            server.close()
            await server.wait_closed()
            self._reader.shutdown(cancel_futures=True)

    def _receive(self, pipe: Connection, view: LiveView) -> None:
        try:
            while pipe.poll():
                view.receive(pipe.recv())
        except (EOFError, OSError):
            asyncio.get_running_loop().remove_reader(pipe.fileno())
            view.lose()
        if view.ended:
            self._ended.set()
        # Each event is awaited by all who serve a program, and set once.
        self._news.set()
        self._news = asyncio.Event()

    async def _sample(self) -> None:
        while self._view is not None:
            self._view.sample()
            await asyncio.sleep(1 / SAMPLE_RATE_HZ)

    async def _on_request(self, connection: ServerConnection, request: Request) -> Response | None:
        response = self._site.answer(request, full=len(self._clients) >= self._most)
        if response is not None and response.status_code in (403, 503):
            self._refused += 1
        # Name of the host and token are checked when a path is found to be unknown.
        if response is None or response.status_code != http.HTTPStatus.NOT_FOUND:
            return response
        parts = urlsplit(request.path)
        path = unquote(parts.path)
        if self._lab is None or not path.startswith(DATA):
            return response
        if not self._access.has_cookie(single_header(request.headers, "Cookie")):
            return text_of(http.HTTPStatus.FORBIDDEN, "Open the page first.\n")
        try:
            body, kind = await asyncio.get_running_loop().run_in_executor(
                self._reader, self._lab.answer, path.removeprefix(DATA), parts.query
            )
        except ValueError as error:
            return text_of(http.HTTPStatus.BAD_REQUEST, f"{error}\n")
        except (KeyError, IndexError, SessionError, ConfigError, OSError) as error:
            return text_of(http.HTTPStatus.NOT_FOUND, f"{_text(error)}\n")
        policy = _REPORT_POLICY if kind.startswith("text/html") else ""
        headers = headers_of(kind, len(body), "", policy)
        return Response(http.HTTPStatus.OK, "OK", headers, body)

    async def _serve(self, client: ServerConnection) -> None:
        self._clients.add(client)
        raw = client.transport.get_extra_info("socket")
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER)
        raw.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        listening = asyncio.create_task(self._listen_to(client))
        path = "" if client.request is None else urlsplit(client.request.path).path
        try:
            await self._show(client, listening, program=path == FORCES)
        except ConnectionClosed:
            pass
        except TimeoutError:
            # It does not read, so no close frame would arrive.
            client.transport.abort()
        finally:
            self._clients.discard(client)
            listening.cancel()

    async def _show(
        self, client: ServerConnection, listening: asyncio.Task[str], *, program: bool
    ) -> None:
        """Send a page the state at intervals, or a program each force as soon as it is there."""
        view, sent = self._view, Counter[str]()
        hello = {"live": None} if view is None else view.hello()
        if not program:
            await self._send(client, {"kind": "hello", "lab": self._lab is not None, **hello})
        elif view is not None:
            view.stream(sent)
        while not listening.done():
            ended, news = self._ended.is_set(), asyncio.ensure_future(self._news.wait())
            if view is not None:
                clients = {"watchers": len(self._clients), "refused": self._refused}
                for message in view.stream(sent) if program else view.news(sent, clients):
                    await self._send(client, message)
            if ended:
                await client.close(1001, "the command ended")
                return
            period = STATE_PERIOD if view is not None else None
            until = {listening, news} if program else {listening}
            await asyncio.wait(until, timeout=period, return_when=asyncio.FIRST_COMPLETED)
            news.cancel()
        if reason := listening.result():
            await client.close(1008, reason)

    async def _send(self, client: ServerConnection, message: dict[str, Any] | bytes) -> None:
        async with asyncio.timeout(PATIENCE):
            await client.send(message if isinstance(message, bytes) else json.dumps(message))

    async def _listen_to(self, client: ServerConnection) -> str:
        """Carry out messages until the client leaves; return why it is disconnected, or ''."""
        received: list[int] = []
        try:
            async for text in client:
                now_ns = self._clock.now_ns()
                received = [t for t in received if now_ns - t < MESSAGE_WINDOW * SECOND_NS]
                received.append(now_ns)
                if len(received) > MAX_MESSAGES:
                    self._refused += 1
                    return "too many messages"
                message = parse_message(text, self._view.commands if self._view else ())
                if isinstance(message, Marks) and self._lab is not None:
                    await self._send(client, await self._mark(self._lab, message))
                elif isinstance(message, str) and self._pipe is not None:
                    if not self._ended.is_set():
                        self._pipe.send(message)
                else:
                    self._refused += 1
        except (ConnectionClosed, OSError):
            pass
        return ""

    async def _mark(self, lab: Lab, marks: Marks) -> dict[str, Any]:
        loop = asyncio.get_running_loop()
        try:
            answer = await loop.run_in_executor(
                self._reader, lab.mark, marks.session, marks.targets
            )
        except (KeyError, SessionError, ConfigError, OSError) as error:
            answer = {"error": _text(error)}
        return {"kind": "marks", "session": marks.session, **answer}


def parse_message(message: str | bytes, commands: tuple[str, ...]) -> str | Marks | None:
    """Return the command or the marks in a client's message, or None for anything else.

    Allowed: `{"command": one of commands}`, and `{"session": its path, "again": [numbers of
    targets, from 1]}`.
    """
    try:
        content = json.loads(message)
    except (ValueError, RecursionError):
        return None
    match content:
        case {"command": str(command), **others} if not others and command in commands:
            return command
        case {"session": str(session), "again": list(targets), **others} if not others:
            if all(type(target) is int and target >= 1 for target in targets):
                return Marks(session, tuple(sorted(set(targets))))
    return None


def _text(error: Exception) -> str:
    return str(error.args[0] if isinstance(error, KeyError) and error.args else error)
