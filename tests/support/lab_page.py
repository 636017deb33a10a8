"""A lab of made sessions, its page, and clients for it."""

import json
import re
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

from support.collecting import ROOT
from support.sessions import make_session, set_attrs
from websockets.sync.client import connect

from rig.acquire.collector import target_table
from rig.bench.bench import BenchFile
from rig.core.packaged import BENCHES
from trajectories import plan_to_json

BENCH = BenchFile.read(BENCHES / "gelsight.yaml").bench
PLAN = BENCH.trajectory
TARGETS = 50


def make_lab(folder: Path) -> Path:
    """Make sessions of a camera and of taxels, one that is recording, and one without a plan."""
    known = {"plan": plan_to_json(PLAN), "targets_wanted": TARGETS, "indenter": "moon"}
    day = folder / "sessions" / "day"
    day.mkdir(parents=True)
    camera = make_session(
        day / "moon.zarr", shape=(480, 640), targets=target_table(PLAN, TARGETS, BENCH)
    )
    started = {"started_utc": "2026-11-24T08:00:00Z"}
    set_attrs(camera, **known, **started, sensor="gelsight", operator="Ada")
    taxels = make_session(folder / "sessions" / "u.zarr", names=("taxels", "force", "pose"))
    set_attrs(taxels, **known, sensor="uskin", summary={"taxels": {"dropped": 3}})
    make_session(folder / "sessions" / "live.zarr", finish=False)
    make_session(folder / "sessions" / "import.zarr", names=("camera",), codec="zstd")
    return folder


class LabPage:
    """One running page of a lab."""

    def __init__(self, folder: Path, port: int, token: str = "") -> None:
        self.folder = folder
        self.base = f"http://127.0.0.1:{port}"
        with urllib.request.urlopen(f"{self.base}/{token}") as answer:
            self.cookie = answer.headers["Set-Cookie"].split(";")[0]

    def fetch(self, path: str, **headers: str) -> tuple[int, bytes, Any]:
        """Return status, body and headers of an answer."""
        request = urllib.request.Request(
            self.base + path, headers={"Cookie": self.cookie, **headers}
        )
        try:
            with urllib.request.urlopen(request) as answer:
                return answer.status, answer.read(), answer.headers
        except urllib.error.HTTPError as error:
            return error.code, error.read(), error.headers

    def get(self, path: str) -> Any:
        """Return the content of an answer."""
        status, body, _ = self.fetch(path)
        assert status == 200, body
        return json.loads(body)

    def send(self, message: str | bytes, origin: str | None = None) -> Any:
        """Return the answer to a message, sent as the page's script does."""
        with connect(
            f"ws{self.base[4:]}/live",
            origin=origin or self.base,  # type: ignore[arg-type]
            additional_headers={"Cookie": self.cookie},
            compression=None,
        ) as client:
            client.send(message)
            while (answer := json.loads(client.recv(timeout=240))).pop("kind") != "marks":
                pass
            return answer


SERVER = """
import asyncio
from pathlib import Path
from rig.core.clock import SystemClock
from rig.monitor.access import AccessPolicy
from rig.monitor.lab import Folders
from rig.monitor.server import PageServer
page = PageServer(AccessPolicy(port=0), Folders(Path("sessions")), SystemClock())
asyncio.run(page.run(lambda port: print(f"watch it at http://127.0.0.1:{port}/", flush=True)))
"""


def serving(folder: Path) -> AbstractContextManager[LabPage]:
    """Serve the page of a lab with the priority of a test; `tactile page` has a lower one."""
    return _served(folder, "-c", SERVER)


def running(folder: Path, *options: str) -> AbstractContextManager[LabPage]:
    """Run `tactile page` in a folder."""
    return _served(folder, "-m", "tactile", "page", "--port", "0", *options)


@contextmanager
def _served(folder: Path, *arguments: str) -> Iterator[LabPage]:
    process = subprocess.Popen(
        [sys.executable, *arguments],
        cwd=folder,
        env={"PYTHONPATH": str(ROOT), "PATH": ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert process.stdout is not None
    try:
        line = process.stdout.readline()
        found = re.search(r"watch it at http://\S+?:(\d+)/(\S*)", line)
        assert found, line + process.stdout.read()
        yield LabPage(folder, int(found[1]), found[2])
    finally:
        process.terminate()
        output, _ = process.communicate(timeout=240)
    assert process.returncode == 0, output
    assert "Traceback" not in output
