"""Files of the page, and access to it, decided from a request's headers alone.

Three attacks are prevented. Another machine gets nothing without the token. Another web site in the
operator's browser has a different Origin. A foreign DNS name that points at this machine gives a
different Host. The token is in the address once and in a cookie from then on, which only this
page's own requests send (HttpOnly, SameSite=Strict).
"""

import contextlib
import fcntl
import hmac
import http
import ipaddress
import secrets
import socket
import struct
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from importlib import resources
from pathlib import Path, PurePath
from urllib.parse import parse_qs, unquote, urlsplit

from websockets.datastructures import Headers
from websockets.http11 import Request, Response

LOOPBACK_HOST = "127.0.0.1"
# Hosts that stand for all addresses of this machine.
ANY_HOST = ("0.0.0.0", "::")
DEFAULT_PORT = 8765
# Linux: asks for the IPv4 address of an interface; and its list of IPv6 addresses.
_SIOCGIFADDR = 0x8915
_IF_INET6 = Path("/proc/net/if_inet6")


def is_loopback(host: str) -> bool:
    """Return True if only this machine can reach a server bound to `host`."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def own_addresses(host: str) -> list[str]:
    """Return this machine's addresses for others, IPv4 (0.0.0.0) or IPv6 (::), or loopback."""
    addresses = _ipv4_addresses() if host == "0.0.0.0" else _ipv6_addresses()
    others = [address for address in addresses if not is_loopback(address)]
    return others or [LOOPBACK_HOST if host == "0.0.0.0" else "::1"]


def _ipv4_addresses() -> list[str]:
    addresses = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        for _, name in socket.if_nameindex():
            # An interface without an address raises an error.
            with contextlib.suppress(OSError):
                request = struct.pack("256s", name.encode()[:15])
                answer = fcntl.ioctl(probe.fileno(), _SIOCGIFADDR, request)
                addresses.append(socket.inet_ntoa(answer[20:24]))
    return addresses


def _ipv6_addresses() -> list[str]:
    try:
        rows = [line.split() for line in _IF_INET6.read_text().splitlines()]
    except OSError:
        return []
    # Only addresses of global scope are reachable without the name of an interface.
    return [
        socket.inet_ntop(socket.AF_INET6, bytes.fromhex(row[0])) for row in rows if row[3] == "00"
    ]


@dataclass(frozen=True, slots=True)
class AccessPolicy:
    """Access policy of the page."""

    host: str = LOOPBACK_HOST
    """Address the server is bound to."""
    port: int = DEFAULT_PORT
    """Its TCP port."""
    token: str = field(default_factory=lambda: secrets.token_urlsafe(18), repr=False)
    """144 random bits; never logged."""

    @property
    def cookie(self) -> str:
        """Name of the cookie; it contains the port, since browsers share cookies between ports."""
        return f"rig_watch_{self.port}"

    def knows_host(self, host: str | None) -> bool:
        """Return True if a Host header names this server, with any port (tunnels may change it).

        A server bound to loopback accepts loopback names; any other accepts addresses and this
        machine's own names.
        """
        if not host:
            return False
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        if is_loopback(name) or name == self.host.lower():
            return True
        if is_loopback(self.host):
            return False
        try:
            ipaddress.ip_address(name)
        except ValueError:
            ours = socket.gethostname().lower()
            return name in (ours, f"{ours}.local", socket.getfqdn().lower())
        return True

    def may_open(self, path: str, cookies: str | None) -> bool:
        """Return True for a page of this machine, or with the token in path or Cookie header."""
        if is_loopback(self.host):
            return True
        return self._is_token(_query_token(path)) or self.has_cookie(cookies)

    def has_cookie(self, cookies: str | None) -> bool:
        """Return True if a Cookie header holds the token; required for live data and commands."""
        jar: SimpleCookie = SimpleCookie()
        try:
            jar.load(cookies or "")
        except CookieError:
            return False
        return self.cookie in jar and self._is_token(jar[self.cookie].value)

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode("utf-8", "replace"), self.token.encode())


def urls_of(access: AccessPolicy, port: int) -> list[str]:
    """Return the addresses of a page, with the token if it is required.

    There is one for each network of this machine if the page serves all of them. They are numbers,
    since a tablet need not know this machine's name.
    """
    token = "" if is_loopback(access.host) else f"?token={access.token}"
    hosts = own_addresses(access.host) if access.host in ANY_HOST else [access.host]
    return [f"http://{f'[{host}]' if ':' in host else host}:{port}/{token}" for host in hosts]


def _query_token(path: str) -> str:
    try:
        return parse_qs(urlsplit(path).query).get("token", [""])[0]
    except ValueError:
        return ""


# Files of the page, and the headers that protect them from other sites.


# Path of the page's WebSocket, and of that of a program that receives forces.
LIVE, FORCES = "/live", "/forces"

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

        `full` is True if the limit of open pages is reached.
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
        origins = request.headers.get_all("Origin")
        if path == FORCES and origins in ([], [f"http://{host}"]):
            # A program has no origin; the page of another site has.
            return self._refuse(request, cookies) or _refuse_more(full=full)
        if refusal := self._refuse(request, cookies):
            return refusal
        if path not in self._files:
            return text_of(http.HTTPStatus.NOT_FOUND, "There is no such page.\n")
        body, kind = self._files[path]
        headers = headers_of(kind, len(body), host or "")
        if path == "/":
            grant = f"{self._access.cookie}={self._access.token}"
            headers["Set-Cookie"] = f"{grant}; Path=/; HttpOnly; SameSite=Strict"
        return Response(http.HTTPStatus.OK, "OK", headers, body)

    def _refuse(self, request: Request, cookies: str | None) -> Response | None:
        if self._access.may_open(request.path, cookies):
            return None
        text = "This page requires the token in the address that the command printed.\n"
        return text_of(http.HTTPStatus.FORBIDDEN, text)

    def _refuse_live(
        self, request: Request, host: str | None, cookies: str | None, *, full: bool
    ) -> Response | None:
        if not host or single_header(request.headers, "Origin") != f"http://{host}":
            return text_of(http.HTTPStatus.FORBIDDEN, "Another site's page may not watch.\n")
        if not self._access.has_cookie(cookies):
            return text_of(http.HTTPStatus.FORBIDDEN, "Open the page first; it brings the token.\n")
        return _refuse_more(full=full)


def _refuse_more(*, full: bool) -> Response | None:
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
    """Return the headers of a response of `length` bytes, which keep other sites out.

    A page of `host`, which has been checked, may open its WebSocket. `policy` is the content policy
    of what is not one of the page's own files.
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
