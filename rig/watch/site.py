"""The HTTP side: a handful of known files, and the headers that keep strangers out of them."""

from __future__ import annotations

import http
from importlib import resources
from urllib.parse import unquote, urlsplit

from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from rig.watch.gate import Gate

LIVE = "/live"
"""Path of the WebSocket."""

_FILES = {
    "/": ("page.html", "text/html; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/traces.js": ("traces.js", "text/javascript; charset=utf-8"),
    "/map.js": ("map.js", "text/javascript; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
}


class Site:
    """Answers every request that is not for the WebSocket, and judges those that are.

    The files are read once, here: no path that a client sends ever reaches the disk.

    Args:
        gate: Who may.
    """

    def __init__(self, gate: Gate) -> None:
        self._gate = gate
        folder = resources.files("rig.watch") / "static"
        self._files = {
            path: ((folder / name).read_bytes(), kind) for path, (name, kind) in _FILES.items()
        }

    def answer(self, request: Request, *, full: bool) -> Response | None:
        """The response, or None when the WebSocket may be opened.

        Args:
            request: Of the client.
            full: Whether there are as many watchers as may be.
        """
        host = _single(request.headers, "Host")
        if not self._gate.knows_host(host):
            return _text(http.HTTPStatus.FORBIDDEN, "This name is not one of this bench's.\n")
        cookies = _single(request.headers, "Cookie")
        try:
            path = unquote(urlsplit(request.path).path)
        except ValueError:
            return _text(http.HTTPStatus.BAD_REQUEST, "That is no address.\n")
        if path == LIVE:
            return self._refuse_live(request, host, cookies, full=full)
        if not self._gate.may_open(request.path, cookies):
            return _text(
                http.HTTPStatus.FORBIDDEN,
                "This page asks for the token in the address that the collection printed.\n",
            )
        if path not in self._files:
            return _text(http.HTTPStatus.NOT_FOUND, "There is no such page.\n")
        body, kind = self._files[path]
        headers = _headers(kind, len(body), host or "")
        if path == "/":
            headers["Set-Cookie"] = self._gate.set_cookie
        return Response(http.HTTPStatus.OK, "OK", headers, body)

    def _refuse_live(
        self, request: Request, host: str | None, cookies: str | None, *, full: bool
    ) -> Response | None:
        if not self._gate.same_origin(_single(request.headers, "Origin"), host):
            return _text(http.HTTPStatus.FORBIDDEN, "Another site's page may not watch.\n")
        if not self._gate.has_cookie(cookies):
            return _text(http.HTTPStatus.FORBIDDEN, "Open the page first; it brings the token.\n")
        if full:
            return _text(http.HTTPStatus.SERVICE_UNAVAILABLE, "Enough people are watching.\n")
        return None


def _single(headers: Headers, name: str) -> str | None:
    """A header that came once; one that came twice counts as not sent."""
    values = headers.get_all(name)
    return values[0] if len(values) == 1 else None


def _text(status: http.HTTPStatus, text: str) -> Response:
    body = text.encode()
    headers = _headers("text/plain; charset=utf-8", len(body), "")
    return Response(status, status.phrase, headers, body)


def _headers(kind: str, length: int, host: str) -> Headers:
    # Older tablets do not count ws: as 'self'. The host was judged before it is repeated here.
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
