"""The collecting process's side of the page: no event of the page disturbs it."""

import logging
import multiprocessing
import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.waiting import until
from support.watching import TARGETS, WatchedBench, next_state, watch
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection

from rig.acquire.control import Control
from rig.core.errors import ConfigError
from rig.monitor.access import AccessPolicy
from rig.monitor.collection import CollectionView, Snapshot
from rig.monitor.page_process import run_page

pytestmark = pytest.mark.slow


@pytest.fixture
def watched_bench(tmp_path: Path) -> Iterator[WatchedBench]:
    made = WatchedBench(tmp_path)
    yield made
    made.close()


@pytest.mark.parametrize("recording", [True, False], ids=["the end", "an error before recording"])
def test_the_end_is_shown_before_the_server_goes(
    recording: bool, watched_bench: WatchedBench
) -> None:
    access = AccessPolicy(port=0)
    page = watched_bench.page(access).__enter__()
    with watch(access, page.port) as client:
        assert next_state(client)["status"] == "preparing"
        if recording:
            page.begin(Control(), dict, watched_bench.session, 0)
            until(lambda: next_state(client)["status"] == "collecting")
            page.say("complete", "160 of 160 targets")
            page.close()
            assert last_words(client) == ("complete: 160 of 160 targets", 1001)
        else:
            page.__exit__(ConfigError, ConfigError("force: not there"), None)
            assert last_words(client) == ("stopped: force: not there", 1001)


def test_log_lines_reach_the_page_and_the_token_is_in_none(
    watched_bench: WatchedBench, caplog: pytest.LogCaptureFixture
) -> None:
    access = AccessPolicy(host="0.0.0.0", port=0)
    caplog.set_level(logging.DEBUG)
    with watched_bench.page(access) as page, watch(access, page.port) as client:
        logging.getLogger("rig.test").info("target %d of %d", 3, TARGETS)
        seen: list[str] = []
        while not seen:
            seen += next_state(client)["log"]
    assert seen[0].endswith(f"target 3 of {TARGETS}")
    ours = [r.getMessage() for r in caplog.records if not r.name.startswith("websockets.client")]
    assert not any(access.token in line for line in ours)


def test_a_killed_page_is_mentioned_once_and_the_pause_it_asked_for_stays(
    watched_bench: WatchedBench, caplog: pytest.LogCaptureFixture
) -> None:
    access, control = AccessPolicy(port=0), Control()
    with watched_bench.page(access) as page:
        page.begin(control, dict, watched_bench.session, 0)
        with watch(access, page.port) as client:
            client.send('{"command": "pause"}')
            until(lambda: control.paused_by == ("page",))
        os.kill(child(), signal.SIGKILL)
        until(lambda: "the pause it requested stays" in caplog.text)
        page.say("ending")
        page.say("complete")
    assert caplog.text.count("the monitoring page is gone") == 1
    assert control.paused_by == ("page",)


def test_a_frozen_page_holds_nobody_up(watched_bench: WatchedBench) -> None:
    frozen: list[int] = []

    def progress() -> dict[str, str]:
        frozen.append(child())
        os.kill(frozen[0], signal.SIGSTOP)
        return {"phase": "x" * 2_000_000}

    with watched_bench.page() as page:
        page.begin(Control(), progress, watched_bench.session, 0)
        until(lambda: frozen)
        page.say("ending")  # handed over, not delivered
    assert not Path(f"/proc/{frozen[0]}").exists()


def test_an_address_in_use_or_not_ours_is_wrong_input(watched_bench: WatchedBench) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        used = rf"--watch: found 127\.0\.0\.1:{port}: .*in use"
        for host, text in (("127.0.0.1", used), ("192.0.2.7", "--watch")):
            page = watched_bench.page(AccessPolicy(host, port))
            with pytest.raises(ConfigError, match=text), page:
                pass


def test_a_collecting_process_that_vanishes_is_shown_and_the_page_ends(
    watched_bench: WatchedBench,
) -> None:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    access = AccessPolicy(port=0)
    arguments = (access, watched_bench.folders(), CollectionView, watched_bench.job(), theirs)
    process = context.Process(target=run_page, args=arguments)
    process.start()
    theirs.close()
    port = ours.recv()
    with watch(access, port) as client:
        ours.send(Snapshot(status="collecting", outcomes="d" + "." * (TARGETS - 1)))
        until(lambda: next_state(client)["status"] == "collecting")
        ours.close()
        until(lambda: next_state(client)["status"] == "gone")
    process.join(20)
    assert process.exitcode == 0


def test_earlier_runs_are_on_the_map_of_a_resumed_session(watched_bench: WatchedBench) -> None:
    writer = watched_bench.writer()
    for target, outcome in ((0, 0), (1, 0), (1, 1), (2, 0)):
        writer.segments.append(
            target=target, phase=0, outcome=outcome, run=0, start_ns=1 + target, end_ns=2 + target
        )
    writer.close()
    access = AccessPolicy(port=0)
    with watched_bench.page(access) as page:
        page.begin(Control(), dict, watched_bench.session, 3)
        with watch(access, page.port) as client:
            until(lambda: next_state(client)["outcomes"].startswith("dld."))


def last_words(client: ClientConnection) -> tuple[str, int | None]:
    """Return status and reason of the last state, and the code with which the server closed."""
    last = ""
    try:
        while True:
            state = next_state(client)
            last = f"{state['status']}: {state['reason']}"
    except ConnectionClosed as closed:
        return last, closed.rcvd.code if closed.rcvd else None


def child() -> int:
    """Return the page's process: the only child except the resource tracker."""
    found = [p.pid for p in multiprocessing.active_children() if p.name == "page"]
    assert len(found) == 1
    assert found[0] is not None
    return int(found[0])
