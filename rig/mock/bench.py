"""The mock bench: starts the emulators of a bench's devices and their common World.

    python -m rig mock --sensor tacpalm

Every emulator is a separate process that speaks its device's protocol on a loopback address. The
rig gets only those addresses: it runs the same drivers as in the lab.
"""

from __future__ import annotations

import json
import logging
import os
import socket
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

from rig.bench.bench import Bench, addressed, bench_from
from rig.bench.worlds import SimulatedSpec
from rig.core.clock import SystemClock
from rig.core.errors import ConfigError, DeviceLost
from rig.core.samples import ARM_TRUTH, PRESS_STATE, WORLD_STATE
from rig.core.shared_memory import SharedLatest
from rig.core.sources import Sources
from rig.mock.emulators import MockBenchSpec, emulator_commands, world_commands
from rig.mock.processes import ProcessGroup, StartedOrClosed
from rig.mock.world.simulated import PRESS_FILE

logger = logging.getLogger(__name__)

_UR_PORTS = (29999, 30001, 30002, 30003, 30004)


class MockBench(StartedOrClosed):
    """The emulators of one bench, as a context manager.

    Args:
        content: A mock bench as read from YAML, with `loopback` addresses.
        where: Its file, for error messages.
        folder: Empty run folder for shared records.
        sources: Real recordings to play.
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
        self._launched = ProcessGroup(folder, SystemClock())
        self._closed = False

    def _start(self) -> None:
        spec = self._folder / "world.json"
        contact_frame = list(self.bench.world_frame or self.bench.contact_frame)
        spec.write_text(
            json.dumps(
                {
                    "world": self.content["world"],
                    "contact_frame": contact_frame,
                    "indenter": self.bench.indenter,
                }
            )
        )
        self.arm_path = self._folder / "arm.state"
        self.world_path = self._folder / "world.state"
        SharedLatest.create(self.arm_path, ARM_TRUTH).close()
        SharedLatest.create(self.world_path, WORLD_STATE).close()
        if isinstance(self.bench.world, SimulatedSpec):
            SharedLatest.create(self._folder / PRESS_FILE, PRESS_STATE).close()
        bench_spec = MockBenchSpec(
            self.bench,
            self.host,
            self._folder,
            spec,
            arm=self.arm_path,
            world=self.world_path,
            sources=self._sources,
            truth=self._truth,
        )
        commands = {**emulator_commands(bench_spec), **world_commands(bench_spec)}
        for name, arguments in commands.items():
            self._launched.start(name, arguments)
        self._launched.wait_ready()

    @property
    def processes(self) -> dict[str, subprocess.Popen[str]]:
        """The emulators and the World, by name."""
        return self._launched.processes

    def check(self) -> None:
        """Raise if an emulator or the World has ended by itself.

        Raises:
            DeviceLost: Names it, with its last line of output.
        """
        self._launched.check()

    def close(self) -> None:
        """End every emulator; may be called twice."""
        self._launched.close()
        if "solver" in self.processes and not self._closed:
            # The number of solutions shows how accurate the World was.
            logger.info(self._launched.last_word("solver"))
        self._closed = True


def free_loopback() -> str:
    """Return a 127.x.y.z address without a listener on a UR controller's ports.

    The ports are fixed in the client library, so simultaneous benches need different addresses.

    Raises:
        DeviceLost: Every address tried is in use.
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
