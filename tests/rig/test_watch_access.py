"""Access to the page, decided from headers alone."""

import pytest
from websockets.datastructures import Headers
from websockets.http11 import Request

from rig.monitor.access import AccessPolicy, Site, is_loopback, urls_of

LOCAL = AccessPolicy("127.0.0.1", 8765, "local-token")
REMOTE = AccessPolicy("0.0.0.0", 8765, "remote-token")


def ask(access: AccessPolicy, path: str, *, full: bool = False, **headers: str) -> int:
    """Return the status of the answer; 101 if the WebSocket would be opened."""
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    response = Site(access).answer(Request(path, Headers(named)), full=full)
    return 101 if response is None else response.status_code


def cookie(access: AccessPolicy) -> str:
    return f"{access.cookie}={access.token}"


@pytest.mark.parametrize(
    ("hosts", "loopback"),
    [
        (("127.0.0.1", "127.8.9.10", "localhost", "::1"), True),
        (("0.0.0.0", "192.168.1.4", "::", "evil.example", ""), False),
    ],
)
def test_loopback_addresses_are_known(hosts: tuple[str, ...], loopback: bool) -> None:
    assert [is_loopback(host) for host in hosts] == [loopback] * len(hosts)


@pytest.mark.parametrize("host", ["localhost:8765", "127.0.0.1:8765", "[::1]:8765", "localhost:90"])
def test_a_local_page_answers_to_local_names_through_any_tunnel(host: str) -> None:
    assert ask(LOCAL, "/", Host=host) == 200


@pytest.mark.parametrize(
    "host", ["evil.example:8765", "192.168.1.4:8765", "127.0.0.1.evil.example", "", "[", "a@b:1"]
)
def test_a_name_that_points_here_by_somebody_elses_dns_is_refused(host: str) -> None:
    is_address = host == "192.168.1.4:8765"
    assert ask(REMOTE, "/?token=remote-token", Host=host) == (200 if is_address else 403)
    assert ask(LOCAL, "/", Host=host) == 403
    assert ask(LOCAL, "/live", Host=host, Origin=f"http://{host}", Cookie=cookie(LOCAL)) == 403


@pytest.mark.parametrize("path", ["/", "/page.js", "/page.css", "/icon.svg", "/nothing"])
def test_a_remote_client_sees_nothing_without_the_token(path: str) -> None:
    host = "192.168.1.4:8765"
    assert ask(REMOTE, path, Host=host) == 403
    assert ask(REMOTE, f"{path}?token=", Host=host) == 403
    assert ask(REMOTE, f"{path}?token=wrong", Host=host) == 403
    assert ask(REMOTE, path, Host=host, Cookie=f"{REMOTE.cookie}=wrong") == 403
    assert ask(REMOTE, path, Host=host, Cookie=';;=,="{') == 403
    expected = 404 if path == "/nothing" else 200
    assert ask(REMOTE, path, Host=host, Cookie=cookie(REMOTE)) == expected


@pytest.mark.parametrize("access", [LOCAL, REMOTE], ids=["local", "remote"])
def test_live_data_ask_for_our_origin_and_the_cookie(access: AccessPolicy) -> None:
    host = "127.0.0.1:8765"
    good = {"Host": host, "Origin": f"http://{host}", "Cookie": cookie(access)}
    assert ask(access, "/live", **good) == 101
    assert ask(access, "/live", full=True, **good) == 503
    for origin in ("http://evil.example", "null", f"https://{host}", "http://127.0.0.1:9"):
        assert ask(access, "/live", **{**good, "Origin": origin}) == 403
    for missing in ("Host", "Origin", "Cookie"):
        assert ask(access, "/live", **{k: v for k, v in good.items() if k != missing}) == 403
    assert ask(access, "/live", **{**good, "Cookie": f"{access.cookie}={access.token}x"}) == 403
    # The token in the address gives access to the page, not to the data.
    assert ask(access, f"/live?token={access.token}", Host=host, Origin=f"http://{host}") == 403


def test_a_program_receives_forces_with_the_token_and_a_page_of_another_site_does_not() -> None:
    here, there = "localhost:8765", "192.168.1.4:8765"
    assert ask(LOCAL, "/forces", Host=here) == 101
    assert ask(LOCAL, "/forces", Host=here, Origin=f"http://{here}") == 101
    assert ask(LOCAL, "/forces", Host=here, Origin="http://evil.example") == 404
    assert ask(LOCAL, "/forces", Host="evil.example") == 403
    assert ask(LOCAL, "/forces", Host=here, full=True) == 503
    assert ask(REMOTE, "/forces", Host=there) == 403
    assert ask(REMOTE, "/forces?token=wrong", Host=there) == 403
    assert ask(REMOTE, "/forces?token=remote-token", Host=there) == 101


def test_a_header_sent_twice_counts_as_not_sent() -> None:
    headers = Headers([("Host", "127.0.0.1:8765"), ("Host", "evil.example")])
    response = Site(LOCAL).answer(Request("/", headers), full=False)
    assert response is not None
    assert response.status_code == 403


@pytest.mark.parametrize(
    "path",
    [
        "/../server.py",
        "/static/page.html",
        "/%2e%2e/%2e%2e/etc/passwd",
        "//etc/passwd",
        "http://[",
        "/page.js/../../gate.py",
        "/page.html",
        "/page.js%00",
        "",
    ],
)
def test_only_known_files_are_served(path: str) -> None:
    assert ask(LOCAL, path, Host="localhost:8765") in (400, 404)


def test_the_page_comes_with_its_cookie_and_strict_headers_and_scripts_without_it() -> None:
    page, script = (
        Site(LOCAL).answer(Request(path, Headers({"Host": "localhost:8765"})), full=False)
        for path in ("/", "/page.js")
    )
    assert page is not None
    assert page.headers["Set-Cookie"] == (
        "rig_watch_8765=local-token; Path=/; HttpOnly; SameSite=Strict"
    )
    policy = page.headers["Content-Security-Policy"]
    assert "unsafe" not in policy
    for words in ("default-src 'none'", "frame-ancestors 'none'", "ws://localhost:8765"):
        assert words in policy
    assert page.headers["X-Content-Type-Options"] == "nosniff"
    assert page.headers["Cache-Control"] == "no-store"
    assert b"local-token" not in (page.body or b"")
    assert script is not None
    assert "Set-Cookie" not in script.headers


def test_an_ipv6_address_is_printed_as_one() -> None:
    assert urls_of(AccessPolicy(host="::1"), 8765) == ["http://[::1]:8765/"]


def test_tokens_differ_and_do_not_show() -> None:
    first, second = AccessPolicy(), AccessPolicy()
    assert first.token != second.token
    assert len(first.token) >= 24
    assert first.token not in repr(first)
