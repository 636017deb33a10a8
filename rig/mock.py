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
from pathlib import Path
from typing import Any

import numpy as np

from rig.bench import Bench, addressed, bench_from
from rig.clock import SECOND_NS, SystemClock
from rig.emulators import Sources, Stage, emulator_commands, world_command
from rig.errors import ConfigError, DeviceLost
from rig.latest import ARM_TRUTH, WORLD_STATE
from rig.shared import LatestRecord

logger = logging.getLogger(__name__)

_READY_TIMEOUT = 30.0
# Interpreters start one after the other on a small machine [s].
_UR_PORTS = (29999, 30001, 30002, 30003, 30004)


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
        self.content = addressed(content, self.host, folder)
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
        contact_frame = list(self.bench.world_frame or self.bench.contact_frame)
        spec.write_text(
            json.dumps({"world": self.content["world"], "contact_frame": contact_frame})
        )
        self.arm_path = self._folder / "arm.state"
        self.world_path = self._folder / "world.state"
        LatestRecord.create(self.arm_path, ARM_TRUTH).close()
        LatestRecord.create(self.world_path, WORLD_STATE).close()
        stage = Stage(
            self.bench,
            self.host,
            self._folder,
            spec,
            arm=self.arm_path,
            world=self.world_path,
            sources=self._sources,
            truth=self._truth,
        )
        commands = {**emulator_commands(stage), "world": world_command(stage)}
        for name, arguments in commands.items():
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
