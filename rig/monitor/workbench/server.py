"""Server of the workbench: the page's files and the data of a lab, one request after the other.

It runs with or without a collection and only reads, except for the marks of targets. All data are
read in one thread at low priority. No request starts a device: what has to be done at the bench is
shown as a command to type there.
"""

from __future__ import annotations

import asyncio
import http
import json
import os
import signal
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any
from urllib.parse import parse_qsl, unquote, urlsplit

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from recorder import SessionError
from rig.core.errors import ConfigError
from rig.monitor.page.access import AccessPolicy
from rig.monitor.page.server import (
    FILES,
    MAX_WATCHERS,
    Site,
    headers_of,
    listen,
    single_header,
    spoke,
    text_of,
)
from rig.monitor.workbench.lab import Lab

_SCRIPT = "text/javascript; charset=utf-8"
PAGES = FILES | {
    "/": ("workbench.html", "text/html; charset=utf-8"),
    "/workbench.css": ("workbench.css", "text/css; charset=utf-8"),
    "/workbench.js": ("workbench.js", _SCRIPT),
    "/replay.js": ("replay.js", _SCRIPT),
    "/curves.js": ("curves.js", _SCRIPT),
}
DATA = "/data/"
# Longest message [bytes], longest value of a query and most values of it.
MAX_MESSAGE, MAX_VALUE, MAX_VALUES = 8192, 300, 12
# Longest time for a request with its answer, and for a message after the connection [s].
_ANSWER_TIMEOUT, _MESSAGE_TIMEOUT = 30.0, 10.0
# A report brings its own style and pictures, and nothing else.
_REPORT_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; sandbox"


class Refused(Exception):
    """A request that has no answer; the text names the reason."""


class Given(dict[str, str]):
    """Values of a query."""

    def __missing__(self, key: str) -> str:
        """Refuse a request that lacks a value."""
        raise Refused(f"{key}: missing")


class WorkbenchServer:
    """Server of one lab.

    Args:
        lab: The lab.
        access: Access policy.
    """

    def __init__(self, lab: Lab, access: AccessPolicy) -> None:
        self._lab = lab
        self._access = access
        self._site = Site(access, PAGES)
        self._reader = ThreadPoolExecutor(1, "workbench", initializer=os.nice, initargs=(5,))
        self._clients = 0
        self._routes: dict[str, Callable[[Given], tuple[bytes, str]]] = {
            "sessions": lambda given: _json(lab.finished.search(given)),
            "session": lambda given: _json(lab.session(given["session"])),
            "frame": lambda given: _json(
                lab.finished.frame(given["session"], _whole(given, "frame"))
            ),
            "image": lambda given: (
                lab.finished.image(given["session"], _whole(given, "frame"), given["camera"]),
                "image/jpeg",
            ),
            "thumbnail": lambda given: (lab.finished.thumbnail(given["session"]), "image/jpeg"),
            "lab": lambda given: _json(lab.state()),
            "plan": lambda given: (lab.plan_picture(given["sensor"]), "image/png"),
            "indenter": lambda given: (lab.indenter_picture(given["name"]), "image/png"),
            "report": lambda given: (lab.report(given["sensor"]), "text/html; charset=utf-8"),
        }

    async def run(self, ready: Callable[[int], None]) -> None:
        """Serve until SIGINT, SIGTERM or SIGHUP.

        Args:
            ready: Called with the port.

        Raises:
            ConfigError: The port or the address cannot be used.
        """
        access = self._access
        try:
            server = await listen(
                access,
                self._serve,
                self._on_request,
                handshake_timeout=_ANSWER_TIMEOUT,
                max_size=MAX_MESSAGE,
            )
        except OSError as error:
            raise ConfigError(
                f"--port: found {access.host}:{access.port}: {error.strerror or error}; allowed: "
                "a free port of this machine"
            ) from None
        port = server.sockets[0].getsockname()[1]
        self._access = replace(access, port=port)
        self._site = Site(self._access, PAGES)
        ending = asyncio.Event()
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            asyncio.get_running_loop().add_signal_handler(number, ending.set)
        ready(port)
        try:
            await ending.wait()
        finally:
            for connection in server.all_connections:
                connection.transport.abort()
            server.close()
            await server.wait_closed()
            self._reader.shutdown(cancel_futures=True)

    async def _on_request(self, connection: ServerConnection, request: Request) -> Response | None:
        spoke(connection)
        response = self._site.answer(request, full=self._clients >= MAX_WATCHERS)
        # Name of the host and token are checked when a path is found to be unknown.
        if response is None or response.status_code != http.HTTPStatus.NOT_FOUND:
            return response
        parts = urlsplit(request.path)
        path = unquote(parts.path)
        route = self._routes.get(path.removeprefix(DATA)) if path.startswith(DATA) else None
        if route is None:
            return response
        if not self._access.has_cookie(single_header(request.headers, "Cookie")):
            return text_of(http.HTTPStatus.FORBIDDEN, "Open the page first.\n")
        loop = asyncio.get_running_loop()
        try:
            given = _query(parts.query)
            body, kind = await loop.run_in_executor(self._reader, route, given)
        except (Refused, ValueError) as error:
            return text_of(http.HTTPStatus.BAD_REQUEST, f"{error}\n")
        except (KeyError, IndexError, SessionError, ConfigError, OSError) as error:
            text = error.args[0] if isinstance(error, KeyError) and error.args else error
            return text_of(http.HTTPStatus.NOT_FOUND, f"{text}\n")
        headers = headers_of(kind, len(body), "")
        if kind.startswith("text/html"):
            del headers["Content-Security-Policy"]
            headers["Content-Security-Policy"] = _REPORT_POLICY
        return Response(http.HTTPStatus.OK, "OK", headers, body)

    async def _serve(self, client: ServerConnection) -> None:
        """Answer one message of a client: the marks of a session."""
        self._clients += 1
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(_MESSAGE_TIMEOUT):
                message = await client.recv()
                try:
                    path, targets = parse_marks(message)
                    answer = await loop.run_in_executor(self._reader, self._lab.mark, path, targets)
                except (Refused, KeyError, SessionError, ConfigError, OSError) as error:
                    text = error.args[0] if isinstance(error, KeyError) else error
                    answer = {"error": str(text)}
                await client.send(json.dumps(answer))
        except ConnectionClosed:
            pass
        except TimeoutError:
            client.transport.abort()
        finally:
            self._clients -= 1


def parse_marks(message: str | bytes) -> tuple[str, tuple[int, ...]]:
    """Return session and numbers of targets, from 1, of a client's message.

    Raises:
        Refused: It is anything else.
    """
    wrong = Refused('allowed: {"session": "path", "again": [numbers of targets, from 1]}')
    try:
        content = json.loads(message)
    except (ValueError, RecursionError):
        raise wrong from None
    if not isinstance(content, dict) or set(content) != {"session", "again"}:
        raise wrong
    path, targets = content["session"], content["again"]
    if not isinstance(path, str) or not isinstance(targets, list):
        raise wrong
    if any(type(target) is not int or target < 1 for target in targets):
        raise wrong
    return path, tuple(sorted(set(targets)))


def _query(text: str) -> Given:
    try:
        pairs = parse_qsl(text, keep_blank_values=True, max_num_fields=MAX_VALUES)
    except ValueError:
        raise Refused(f"a query of more than {MAX_VALUES} values") from None
    if any(len(value) > MAX_VALUE for _, value in pairs):
        raise Refused(f"a value of more than {MAX_VALUE} characters")
    return Given(pairs)


def _whole(given: Given, key: str) -> int:
    text = given[key]
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise Refused(f"{key}: found {text!r}; allowed: a whole number")
    return int(text)


def _json(content: Any) -> tuple[bytes, str]:
    return json.dumps(content).encode(), "application/json"
