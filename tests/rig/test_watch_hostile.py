"""A collection whose page is attacked records as if there were no attack."""

import contextlib
import socket
import threading
import time
import urllib.parse
import urllib.request
from pathlib import Path

import pytest
from support.collecting import faults_of, page_of
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

from benchmarks.faults.collection_run import CollectionRun, quick_bench
from recorder import Session

pytestmark = [pytest.mark.serial, pytest.mark.slow]

_PAUSE = 0.005
# Between two attempts of one attacker [s]: the attackers share two cores with the bench.


def attack(port: int, cookie: str, kind: str, ending: threading.Event, tries: list[str]) -> None:
    where = f"127.0.0.1:{port}"
    held: list[socket.socket] = []
    while not ending.is_set():
        with contextlib.suppress(OSError, WebSocketException, EOFError):
            if kind == "connect":
                held.append(socket.create_connection(("127.0.0.1", port), timeout=2))
                if len(held) > 100:
                    held.pop(0).close()
            elif kind == "garbage":
                with socket.create_connection(("127.0.0.1", port), timeout=2) as client:
                    client.sendall(b"\x00\xff" * 4000)
            else:
                with connect(
                    f"ws://{where}/live",
                    origin=f"http://{where}",  # type: ignore[arg-type]
                    additional_headers={"Cookie": cookie},
                    open_timeout=2,
                    close_timeout=0.1,
                ) as client:
                    if kind == "flood":
                        for _ in range(100):
                            client.send('{"command": "resume"}')
                    elif kind == "big":
                        client.send("x" * 1_000_000)
                    else:
                        # Reads nothing: sent data accumulates until the page disconnects.
                        ending.wait(3.0)
        tries.append(kind)
        time.sleep(_PAUSE)
    for client in held:
        client.close()


def test_no_sample_is_lost_while_the_page_is_attacked(tmp_path: Path) -> None:
    bench = str(quick_bench(tmp_path, "tacpalm"))
    collection = CollectionRun.collect(
        tmp_path / "s.zarr", *("--bench", bench, "--watch", "0", "--targets", "8")
    )
    ending, tries = threading.Event(), []
    threads: list[threading.Thread] = []
    try:
        port = urllib.parse.urlsplit(page_of(collection)).port
        assert port is not None
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/") as answer:
            cookie = answer.headers["Set-Cookie"].split(";")[0]
        threads = [
            threading.Thread(target=attack, args=(port, cookie, kind, ending, tries))
            for kind in ("connect", "garbage", "flood", "big", "slow")
        ]
        collection.until_recording()
        for thread in threads:
            thread.start()
        code = collection.wait(240)
    finally:
        ending.set()
        for thread in threads:
            thread.join()
        collection.kill_all()
    assert code == 0, collection.text
    summary = Session(collection.session).attrs["summary"]
    assert {stream["dropped"] for stream in summary.values()} == {0}
    assert faults_of(collection.session) == []
    assert set(tries) >= {"connect", "garbage", "flood", "big"}
