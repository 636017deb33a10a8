"""The page's process and its clients: friendly, slow, rude, too many."""

import contextlib
import json
import re
import socket
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any

import pytest
from support.waiting import until
from support.watching import TARGETS, WatchedBench, next_image, next_state, watch
from websockets.exceptions import ConnectionClosed, InvalidStatus

from rig.acquire.control import Control, Interrupted
from rig.monitor.access import AccessPolicy
from rig.monitor.collection import COMMANDS, CollectionPage
from rig.monitor.server import ANSWER_TIMEOUT, MAX_MESSAGES, MAX_WATCHERS, parse_message

pytestmark = pytest.mark.slow

PRESSED = (0.3, 0.0, -1.7, 0.0, 0.06, 0.0)


class Running:
    """One page with its mock collection, and the requests it received."""

    def __init__(
        self, watched_bench: WatchedBench, page: CollectionPage, access: AccessPolicy
    ) -> None:
        self.watched_bench, self.page, self.access = watched_bench, page, access

    def begin(self) -> None:
        self.control = Control()
        self.progress: dict[str, Any] = {}
        self.page.begin(self.control, lambda: dict(self.progress), self.watched_bench.session, 0)

    def watch(self, **how: Any) -> Any:
        return watch(self.access, self.page.port, **how)


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    watched_bench, access = WatchedBench(tmp_path_factory.mktemp("page")), AccessPolicy(port=0)
    with watched_bench.page(access) as page:
        yield Running(watched_bench, page, access)
    watched_bench.close()


@pytest.fixture
def running(shared: Running) -> Running:
    shared.begin()
    # Earlier clients are gone, so that no slot is occupied, and the page knows of the run.
    with shared.watch() as client:

        def ready() -> bool:
            state = next_state(client)
            return bool(state["watchers"] == 1 and state["status"] == "collecting")

        until(ready)
    return shared


def test_a_watcher_learns_the_plan_and_the_limits_once(running: Running) -> None:
    with running.watch() as client:
        hello = json.loads(client.recv(timeout=240))
    assert hello["kind"] == "hello"
    assert hello["mock"] is True
    assert len(hello["targets"]) == TARGETS
    assert hello["targets"][9] == [1, 2.25, 1]
    assert {point["point"] for point in hello["points"]} == {1, 2}
    assert hello["limits"]["ratings"][:3] == [10.0, 10.0, 10.0]
    assert hello["limits"]["box"][2][0] == pytest.approx(-5.1)


def test_force_share_tip_and_rates_are_those_of_the_shared_records(running: Running) -> None:
    running.watched_bench.press(PRESSED, (0.001, -0.002, -0.003))
    with running.watch() as client:
        state = next_state(client)
        force, stream = state["forces"]["force"], state["streams"]["force"]
        assert force["wrench"] == pytest.approx([0.3, 0, -1.7, 0, 60.0, 0])
        assert force["load"] == pytest.approx([0.03, 0, 0.17, 0, 0.5, 0])
        # The sensor has a dome of 29 mm, whose top is 0.086 mm lower there.
        assert state["tips"]["pose"] == pytest.approx([1.0, -2.0, -2.914], abs=1e-3)
        assert (stream["rate"], stream["expected"], stream["dropped"]) == (998.0, 1000.0, 3)
        # A force that is no number is shown as none.
        running.watched_bench.press((float("nan"),) * 6, (0.0, 0.0, 0.0))
        until(lambda: next_state(client)["forces"]["force"]["wrench"] == [None] * 6)


def test_the_trace_has_each_sample_once_and_late_watchers_get_the_past(running: Running) -> None:
    with running.watch() as first:
        seen: list[list[float]] = next_state(first)["traces"]["force"]
        for number in range(5):
            running.watched_bench.press((float(number), 0, 0, 0, 0, 0), (0, 0, 0))
            before = len(seen)
            while len(seen) == before:
                seen += next_state(first)["traces"]["force"]
    assert [point[1] for point in seen[-5:]] == [0.0, 1.0, 2.0, 3.0, 4.0]
    times = [point[0] for point in seen]
    assert times == sorted(set(times))
    with running.watch() as second:
        assert next_state(second)["traces"]["force"][-5:] == seen[-5:]


def test_images_are_the_cameras_own_bytes_while_the_shard_grows(running: Running) -> None:
    with running.watch() as client:
        for _ in range(70):
            newest = running.watched_bench.picture()
        until(lambda: next_image(client) == newest)
        newest = running.watched_bench.picture()
        assert next_image(client) == newest


def test_progress_fills_the_map(running: Running) -> None:
    running.progress = {"target": 2, "phase": "shear_inc", "left": 61.5}
    running.progress["ended"] = {0: "done", 1: "limited"}
    with running.watch() as client:
        until(lambda: next_state(client)["target"] == 2)
        state = next_state(client)
        assert state["outcomes"].startswith("dl..")
        assert len(state["outcomes"]) == TARGETS
        assert (state["status"], state["phase"], state["left"]) == ("collecting", "shear_inc", 61.5)
        running.progress = {"target": 2, "phase": "paused by the pedal", "waiting": True}
        until(lambda: next_state(client)["status"] == "paused")


def test_pause_resume_and_abort_reach_the_control(running: Running) -> None:
    with running.watch() as client:
        client.send('{"command": "pause"}')
        until(lambda: running.control.paused_by == ("page",))
        until(lambda: next_state(client)["paused_by"] == ["page"])
        client.send('{"command": "resume"}')
        until(lambda: running.control.paused_by == ())
        client.send('{"command": "abort"}')

        def aborted() -> bool:
            try:
                running.control.check()
            except Interrupted as error:
                return "aborted by the page" in str(error)
            return False

        until(aborted)


@pytest.mark.parametrize(
    "message",
    [
        "",
        "pause",
        "{",
        "[]",
        "null",
        '"pause"',
        b"\x00\xff",
        "[" * 4000,
        '{"command": "halt"}',
        '{"command": ["abort"]}',
        '{"command": "abort", "more": 1}',
        '{"command": "__init__"}',
        '{"session": 1, "again": []}',
        '{"session": "a", "again": [0]}',
        '{"session": "a", "again": [true]}',
        '{"session": "a", "again": ["1"]}',
        '{"session": "a", "again": [1], "start": true}',
    ],
)
def test_what_is_no_command_and_no_marks_is_none(message: str | bytes) -> None:
    assert parse_message(message, COMMANDS) is None
    assert parse_message('{"command": "abort"}', ()) is None  # by the page of a lab


def test_nonsense_of_a_client_does_nothing_and_is_counted(running: Running) -> None:
    with running.watch() as honest:
        before = next_state(honest)["refused"]
        with running.watch() as rude:
            for message in ("{", b"\xff\xfe", "[]", '{"command": "stop"}', "x" * 100):
                rude.send(message)
        until(lambda: next_state(honest)["refused"] == before + 5)
    assert running.control.paused_by == ()
    running.control.check()


def test_a_flood_of_commands_is_cut_off_and_a_frame_too_big_is_not_read(running: Running) -> None:
    with running.watch() as flood:
        with contextlib.suppress(ConnectionClosed):
            for _ in range(50 * MAX_MESSAGES):
                flood.send('{"command": "resume"}')
        assert closed_with(flood) == 1008
    with running.watch() as client:
        client.send("x" * 100_000)
        assert closed_with(client) == 1009
    assert lets_in(running)


def test_no_more_watchers_than_there_are_places(running: Running) -> None:
    with contextlib.ExitStack() as stack:
        clients = [stack.enter_context(running.watch()) for _ in range(MAX_WATCHERS)]
        until(lambda: next_state(clients[0])["watchers"] == MAX_WATCHERS)
        with pytest.raises(InvalidStatus, match="503"), running.watch():
            pass


def test_slow_and_half_open_connections_keep_nobody_waiting(running: Running) -> None:
    where = ("127.0.0.1", running.page.port)
    begun = b"GET / HTTP/1.1\r\nHost: "
    cookie = f"rig_watch_{running.page.port}={running.access.token}"
    # Its answer is never read.
    whole = f"GET /data/lab HTTP/1.1\r\nHost: 127.0.0.1\r\nCookie: {cookie}\r\n\r\n".encode()
    half = []
    try:
        for number in range(199):
            half.append(socket.create_connection(where))
            if number < 10:
                half[-1].sendall(whole)
            elif number % 2:
                half[-1].sendall(begun)
        assert lets_in(running)
        # Before one of them was closed for its silence.
        half[-1].setblocking(False)
        with pytest.raises(BlockingIOError):
            half[-1].recv(1)
    finally:
        for connection in half:
            connection.close()


def test_a_slow_reader_is_let_go_and_nobody_waits_for_it(running: Running) -> None:
    slow = socket.socket()
    slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    slow.connect(("127.0.0.1", running.page.port))
    slow.sendall(
        (
            f"GET /live HTTP/1.1\r\nHost: 127.0.0.1:{running.page.port}\r\n"
            f"Origin: http://127.0.0.1:{running.page.port}\r\n"
            f"Cookie: rig_watch_{running.page.port}={running.access.token}\r\n"
            "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
        ).encode()
    )
    with slow, running.watch() as quick:
        until(lambda: next_state(quick)["watchers"] == 2)
        rows = []

        def only_one_left() -> bool:
            running.watched_bench.picture()
            state = next_state(quick)
            rows.append(state["images"]["camera"])
            return bool(state["watchers"] == 1)

        until(only_one_left)
    # Meanwhile the fast client saw new images all the time.
    assert len(set(rows)) >= 3


def test_a_connection_that_stays_silent_is_closed(running: Running) -> None:
    with socket.create_connection(("127.0.0.1", running.page.port)) as client:
        client.sendall(b"GET / HTTP/1.1\r\n")
        client.settimeout(2 * ANSWER_TIMEOUT)
        assert hung_up(client)
    assert lets_in(running)


def test_sessions_and_benches_are_on_the_page_of_a_collection_too(running: Running) -> None:
    cookie = fetch(running, "/")[1]["Set-Cookie"].split(";")[0]
    address = f"http://127.0.0.1:{running.page.port}/data/"
    for name in ("sessions", "lab"):
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(address + name)
    request = urllib.request.Request(f"{address}sessions", headers={"Cookie": cookie})
    with urllib.request.urlopen(request) as answer:
        (row,) = json.loads(answer.read())["rows"]
    assert (row["path"], row["status"]) == ("s.zarr", "recording")
    with running.watch() as client:
        assert json.loads(client.recv(timeout=240))["lab"] is True
        client.send('{"session": "s.zarr", "again": [1]}')
        message: dict[str, Any] = {}
        while message.get("kind") != "marks":
            received = client.recv(timeout=240)
            message = json.loads(received) if isinstance(received, str) else {}
    assert "is being recorded" in message["error"]


def test_garbage_instead_of_http_is_hung_up_on(running: Running) -> None:
    for garbage in (b"\x16\x03\x01\x02\x00\x01", b"GET / HTTP/1.1\r\n" + b"A: b\r\n" * 500):
        with socket.create_connection(("127.0.0.1", running.page.port)) as client:
            client.sendall(garbage + b"\r\n\r\n")
            client.settimeout(240)
            assert hung_up(client)
    assert lets_in(running)


def test_the_page_is_served_with_everything_it_names(running: Running) -> None:
    page, headers = fetch(running, "/")
    assert running.access.token in headers["Set-Cookie"]
    names = set(re.findall(rb'(?:href|src)="([a-z]+\.[a-z]+)"', page))
    assert names >= {b"page.css", b"page.js", b"icon.svg"}
    scripts = [name for name in names if name.endswith(b".js")]
    while scripts:
        script, _ = fetch(running, f"/{scripts.pop().decode()}")
        imported = set(re.findall(rb'from "\./([a-z]+\.js)"', script)) - names
        names |= imported
        scripts += imported
    assert len(names) > 8
    for name in names:
        assert fetch(running, f"/{name.decode()}")[0]
    with pytest.raises(urllib.error.HTTPError, match="404"):
        fetch(running, "/../server.py")


def fetch(running: Running, path: str) -> tuple[bytes, Any]:
    with urllib.request.urlopen(f"http://127.0.0.1:{running.page.port}{path}") as answer:
        return answer.read(), answer.headers


def lets_in(running: Running) -> bool:
    with running.watch() as client:
        return bool(next_state(client)["status"] == "collecting")


def hung_up(connection: socket.socket) -> bool:
    """Return True once the other side closes, possibly after an answer."""
    with contextlib.suppress(ConnectionResetError):
        while connection.recv(65536):
            pass
    return True


def closed_with(client: Any) -> int | None:
    """Return the code with which the server closes, after any other messages."""
    try:
        while True:
            client.recv(timeout=240)
    except ConnectionClosed as closed:
        return closed.rcvd.code if closed.rcvd else None
