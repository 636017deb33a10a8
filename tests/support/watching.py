"""A page backed only by shared records and a session, and clients for it."""

import functools
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg
from websockets.sync.client import ClientConnection, connect

from recorder import SessionWriter, StreamWriter, camera_spec
from rig.acquire.collector import CollectRequest
from rig.acquire.stream_process import COUNTERS
from rig.bench.bench import BenchFile
from rig.core.clock import SystemClock
from rig.core.packaged import BENCHES
from rig.core.samples import CAMERA_LATEST, FORCE_LATEST, POSE_LATEST
from rig.core.shared_memory import SharedLatest
from rig.monitor.access import AccessPolicy
from rig.monitor.collection import CollectionJob, CollectionPage
from rig.monitor.lab import Folders

BENCH = BenchFile.read(BENCHES / "tacpalm.yaml").bench
TARGETS = 40


@functools.cache
def jpeg(seed: int) -> bytes:
    """Return a camera image that compresses poorly, so that slow clients are noticed."""
    pixels = np.random.default_rng(seed).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    return simplejpeg.encode_jpeg(pixels, quality=60)


@dataclass
class WatchedBench:
    """Mock of a collecting process and its streams: their session and shared records."""

    folder: Path
    images: list[bytes] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.clock = SystemClock()
        self.session = self.folder / "s.zarr"
        kinds = {"force": FORCE_LATEST, "pose": POSE_LATEST, "camera": CAMERA_LATEST}
        self.records = {
            name: SharedLatest.create(self.folder / f"{name}.latest", kind)
            for name, kind in kinds.items()
        }
        self.counters = {
            name: SharedLatest.create(self.folder / f"{name}.counters", COUNTERS)
            for name in self.records
        }
        SessionWriter.create(
            self.session,
            attrs={"sensor": "tacpalm", "rate_hz": 40.0},
            streams=[camera_spec(30.0, height=480, width=640, codec="jpeg")],
            targets={},
        ).close()
        self.camera = StreamWriter.open(self.session / "streams" / "camera")

    def job(self) -> CollectionJob:
        request = CollectRequest(self.session, BENCH.trajectory, TARGETS)
        return CollectionJob.of(BENCH, self.folder, request)

    def folders(self) -> Folders:
        return Folders(self.folder, BENCHES)

    def page(self, access: AccessPolicy | None = None) -> CollectionPage:
        return CollectionPage(access or AccessPolicy(port=0), self.folders(), self.job())

    def writer(self) -> SessionWriter:
        """Return a writer of the session, to add segments."""
        self.camera.close()
        return SessionWriter.resume(self.session)

    def press(self, force: tuple[float, ...], tip: tuple[float, float, float]) -> None:
        """Show a wrench (6,) [N, N m] and a tip position in the contact frame [m]."""
        now_ns = self.clock.now_ns()
        self.records["force"].write((now_ns, 0, force))
        place = np.add(BENCH.contact_frame[:3], tip)
        self.records["pose"].write((now_ns, 0.0, 0, 2, 1.0, (*place, *BENCH.tool_rotation)))
        self.counters["force"].write((now_ns, 900, 800, 3, 998.0, 0.004, 0.0))

    def picture(self) -> bytes:
        """Record one more image and show its row; return its bytes."""
        # A comment makes equal pictures distinct; each takes too long to encode.
        number = len(self.images).to_bytes(4, "big")
        data = b"\xff\xd8\xff\xfe\x00\x06" + number + jpeg(len(self.images) % 4)[2:]
        now_ns = self.clock.now_ns()
        row = self.camera.append(value=data, device_t=float("nan"), t_ns=now_ns)
        self.images.append(data)
        self.records["camera"].write((now_ns, row))
        return data

    def close(self) -> None:
        self.camera.close()
        for record in (*self.records.values(), *self.counters.values()):
            record.close()


def watch(
    access: AccessPolicy, port: int, *, token: str | None = None, origin: str | None = None
) -> ClientConnection:
    """Connect a client like the page's script."""
    where = f"127.0.0.1:{port}"
    return connect(
        f"ws://{where}/live",
        origin=origin if origin is not None else f"http://{where}",  # type: ignore[arg-type]
        additional_headers={"Cookie": f"rig_watch_{port}={token or access.token}"},
        compression=None,
        open_timeout=240,
    )


def next_state(client: ClientConnection) -> dict[str, Any]:
    """Return the next state, ignoring other messages."""
    while True:
        message = client.recv(timeout=240)
        if isinstance(message, str) and (content := json.loads(message))["kind"] == "state":
            return content


def next_image(client: ClientConnection) -> bytes:
    """Return the next image of the first camera."""
    while True:
        message = client.recv(timeout=240)
        if isinstance(message, bytes) and message[0] == 0:
            return message[1:]
