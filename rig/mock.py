"""The mock bench: starts the emulators of a bench's devices and the World they share.

    python -m rig mock --sensor tacpalm

Every emulator is a process of its own that speaks its device's protocol on a loopback address. The
rig is given those addresses and nothing else: it runs the drivers it would run in the lab.
"""

from __future__ import annotations

import json
import logging
import os
import selectors
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from rig.arm.rotation import compose
from rig.bench import Bench, addressed, bench_from
from rig.clock import SECOND_NS, SystemClock
from rig.errors import ConfigError, DeviceLost
from rig.latest import ARM_TRUTH, WORLD_STATE
from rig.shared import LatestRecord

logger = logging.getLogger(__name__)

_READY_TIMEOUT = 30.0
# Interpreters start one after the other on a small machine [s].
_START_HEIGHT = 0.03
# Where the arm waits, above the middle of the sensor [m].
_UR_PORTS = (29999, 30001, 30002, 30003, 30004)


@dataclass(frozen=True, slots=True)
class Sources:
    """Real recordings to serve in place of what the World would show."""

    camera: Path | None = None
    """A folder of images or a video file."""
    camera_motion: str = "moving"
    """`moving`: one source frame per camera frame; `still`: each image held for seconds."""
    taxels: Path | None = None
    """A .npy file of raw counts (T, 48)."""

    def __post_init__(self) -> None:
        """Refuse a path that is not there before anything is started."""
        for name, path in (("CAMERA", self.camera), ("TAXELS", self.taxels)):
            if path is not None and not path.exists():
                raise ConfigError(f"{name}: {path}: no such file or folder")

    def facts(self) -> dict[str, Any]:
        """What the session says of them: names, not paths of this machine."""
        facts: dict[str, Any] = {}
        if self.camera is not None:
            facts["camera"] = {"name": self.camera.name, "motion": self.camera_motion}
        if self.taxels is not None:
            facts["taxels"] = {"name": self.taxels.name}
        return facts


class MockBench:
    """The emulators of one bench, as a context manager.

    Args:
        content: A mock bench as read from YAML, with `loopback` addresses.
        where: Its file, for errors.
        folder: Empty run folder for shared records.
        sources: Real recordings to serve.
        truth: File to log the World's truth to.
    """

    def __init__(
        self,
        content: dict[str, Any],
        where: str,
        folder: Path,
        *,
        sources: Sources | None = None,
        truth: Path | None = None,
    ) -> None:
        self.host = free_loopback()
        self.content = addressed(content, self.host)
        self.bench: Bench = bench_from(self.content, where)
        if self.bench.world is None:
            raise ConfigError(f"{where}.world: missing; allowed: a world, on a mock bench")
        self._folder = folder
        self._sources = sources or Sources()
        self._truth = truth
        self._clock = SystemClock()
        self.processes: dict[str, subprocess.Popen[str]] = {}

    def __enter__(self) -> MockBench:
        try:
            self._start()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _start(self) -> None:
        spec = self._folder / "world.json"
        contact_frame = list(self.bench.contact_frame)
        spec.write_text(
            json.dumps({"world": self.content["world"], "contact_frame": contact_frame})
        )
        self.arm_path = self._folder / "arm.state"
        self.world_path = self._folder / "world.state"
        LatestRecord.create(self.arm_path, ARM_TRUTH).close()
        LatestRecord.create(self.world_path, WORLD_STATE).close()
        for name, arguments in self._commands(spec).items():
            with (self._folder / f"{name}.log").open("w") as log:
                self.processes[name] = subprocess.Popen(
                    [sys.executable, "-m", *arguments, "--until-stdin-closes"],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    text=True,
                    # Ctrl-C is for the collecting process: the bench must outlive the retract.
                    start_new_session=True,
                )
        for name, process in self.processes.items():
            self._wait_ready(name, process)

    def _commands(self, spec: Path) -> dict[str, list[str]]:
        bench, world = self.bench, self.bench.world
        noise = None if world is None else world.noise
        start = compose(bench.contact_frame, (0.0, 0.0, _START_HEIGHT, *bench.tool_rotation))
        states = ["--world", str(self.world_path)]
        host = ["--host", self.host]
        truth = ["--truth", str(self._truth)] if self._truth else []
        commands = {
            "arm": [
                "rig.arm.emulator",
                *host,
                *states,
                *("--state", str(self.arm_path)),
                *("--pose", *(repr(float(value)) for value in start)),
                *("--tcp", *(repr(float(value)) for value in bench.arm.tcp)),
            ],
            "world": [
                "rig.world.host",
                *("--spec", str(spec)),
                *("--arm", str(self.arm_path)),
                *("--world", str(self.world_path)),
                *truth,
            ],
            "force": [
                "rig.force.netft_emulator",
                *host,
                *states,
                *("--http-port", str(bench.force.http_port)),
                *("--udp-port", str(bench.force.udp_port)),
                *(("--noise", str(noise.force)) if noise else ()),
            ],
        }
        if bench.camera is not None:
            shown = ["--view", str(spec)]
            if self._sources.camera is not None:
                motion = self._sources.camera_motion
                shown = ["--source", str(self._sources.camera), "--motion", motion]
            commands["camera"] = [
                "rig.camera.mjpeg_emulator",
                *host,
                *states,
                *("--port", str(urlsplit(bench.camera.address).port)),
                *("--fps", str(bench.camera.rate_hz)),
                *shown,
            ]
        if bench.taxels is not None:
            felt = ["--noise", str(noise.counts)] if noise else []
            if self._sources.taxels is not None:
                felt = ["--source", str(self._sources.taxels)]
            commands["taxels"] = [
                "rig.taxels.xela_emulator",
                *host,
                *states,
                *("--port", str(urlsplit(bench.taxels.address).port)),
                *("--rate-hz", str(bench.taxels.rate_hz)),
                *felt,
            ]
        return commands

    def _wait_ready(self, name: str, process: subprocess.Popen[str]) -> None:
        stdout = process.stdout
        if stdout is None:
            raise RuntimeError(f"{name}: started without a pipe")
        deadline_ns = self._clock.now_ns() + round(_READY_TIMEOUT * SECOND_NS)
        with selectors.DefaultSelector() as selector:
            selector.register(stdout, selectors.EVENT_READ)
            selector.select((deadline_ns - self._clock.now_ns()) / SECOND_NS)
            line = stdout.readline() if selector.select(0) else ""
        if not line.startswith("ready"):
            raise DeviceLost(
                f"{name} emulator did not start on {self.host}: {self._last_word(name)}"
            )

    def check(self) -> None:
        """Notice an emulator, or the World, that ended on its own.

        Raises:
            DeviceLost: Names it, with its last word.
        """
        for name, process in self.processes.items():
            if process.poll() is not None:
                word = self._last_word(name)
                raise DeviceLost(f"{name}: its emulator ended (code {process.returncode}): {word}")

    def _last_word(self, name: str) -> str:
        lines = (self._folder / f"{name}.log").read_text().strip().splitlines()
        return lines[-1] if lines else "no word from it"

    def close(self) -> None:
        """End every emulator; safe twice."""
        for process in self.processes.values():
            process.terminate()
        for process in self.processes.values():
            try:
                process.wait(3.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    pipe.close()


def free_loopback() -> str:
    """A 127.x.y.z address on which nobody listens on a UR controller's ports.

    The ports are fixed in the client library, so benches running side by side need addresses.

    Raises:
        DeviceLost: Every address tried is taken.
    """
    rng = np.random.default_rng(os.getpid())
    for _ in range(50):
        host = "127." + ".".join(str(number) for number in rng.integers(2, 250, 3))
        if all(_is_free(host, port) for port in _UR_PORTS):
            return host
    raise DeviceLost("mock bench: no free loopback address; are many benches running?")


def _is_free(host: str, port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError:
            return False
    return True
