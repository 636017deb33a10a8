"""Access to the page and its commands, decided from a request's headers alone.

Three attacks are prevented. Another machine gets nothing without the token. Another web site in the
operator's browser has a different Origin. A foreign DNS name that points at this machine gives a
different Host. The token is in the address once and in a cookie from then on, which only this
page's own requests send (HttpOnly, SameSite=Strict).
"""

from __future__ import annotations

import contextlib
import fcntl
import hmac
import ipaddress
import secrets
import socket
import struct
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

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
    """Return this machine's addresses in its networks, as other machines reach it.

    Args:
        host: `0.0.0.0` for those of IPv4, `::` for those of IPv6.

    Returns:
        The addresses; without a network, the loopback address of the family.
    """
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

    @property
    def set_cookie(self) -> str:
        """Set-Cookie header that grants a browser access."""
        return f"{self.cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"

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

    def same_origin(self, origin: str | None, host: str | None) -> bool:
        """Return True if an Origin header is that of this page."""
        return bool(host) and origin == f"http://{host}"

    def may_open(self, path: str, cookies: str | None) -> bool:
        """Return True if the page may be shown: on this machine always, to others with the token.

        Args:
            path: Path of the request, with its query.
            cookies: Cookie header.
        """
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

    There is one for each network of this machine if the page serves all of them.
    """
    token = "" if is_loopback(access.host) else f"?token={access.token}"
    hosts = own_addresses(access.host) if access.host in ANY_HOST else [access.host]
    return [f"http://{f'[{host}]' if ':' in host else host}:{port}/{token}" for host in hosts]


def _query_token(path: str) -> str:
    try:
        return parse_qs(urlsplit(path).query).get("token", [""])[0]
    except ValueError:
        return ""
