"""HTTP part of the page: a few fixed files, and the headers that protect them from other sites."""

from __future__ import annotations

import http
from importlib import resources
from pathlib import PurePath
from urllib.parse import unquote, urlsplit

from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from rig.monitor.access import AccessPolicy

# Path of the WebSocket.
LIVE = "/live"

_TYPES = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
_SCRIPTS = ("page", "wire", "widgets", "collection", "forces", "sessions", "benches", "theme")
_FILES = ("page.css", "icon.svg", *(f"{name}.js" for name in _SCRIPTS))


class Site:
    """Answers all requests except those for the WebSocket, which it accepts or rejects.

    The files are read once, here: no path sent by a client ever reaches the disk.

    Args:
        access: Access policy.
    """

    def __init__(self, access: AccessPolicy) -> None:
        self._access = access
        folder = resources.files("rig.monitor") / "static"
        names = {"/": "page.html", **{f"/{name}": name for name in _FILES}}
        self._files = {
            path: ((folder / name).read_bytes(), _TYPES[PurePath(name).suffix])
            for path, name in names.items()
        }

    def answer(self, request: Request, *, full: bool) -> Response | None:
        """Return the response, or None if the WebSocket may be opened.

        Args:
            request: Request of the client.
            full: True if the limit of open pages is reached.
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
                "This page requires the token in the address that the command printed.\n",
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


def headers_of(kind: str, length: int, host: str, policy: str = "") -> Headers:
    """Return the headers of a response, which keep other sites out.

    Args:
        kind: Type of its content.
        length: Its length [bytes].
        host: Host of the page, whose WebSocket may be opened; it has been checked.
        policy: Content policy, if it is not that of the page's own files.
    """
    # Older tablets do not count ws: as 'self'.
    live = f" ws://{host}" if host else ""
    return Headers(
        {
            "Content-Type": kind,
            "Content-Length": str(length),
            "Connection": "close",
            "Cache-Control": "no-store",
            "Content-Security-Policy": policy
            or (
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
