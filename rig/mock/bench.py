"""The mock bench: starts the emulators of a bench's devices and their common World.

    tactile mock --sensor tacpalm

Every emulator is a separate process that speaks its device's protocol on a loopback address. The
rig gets only those addresses: it runs the same drivers as in the lab.
"""

import json
import logging
import os
import re
import selectors
import socket
import subprocess
import sys
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np

from recorder.command_line.extras import extra_of
from rig.bench.bench import Bench, BenchFile
from rig.bench.pair import PairFile
from rig.bench.worlds import Noise, Sources
from rig.core.config import from_si
from rig.core.errors import ConfigError, DeviceLost
from rig.core.mock_names import ARM_FILE, HAND_FILE, PORTS, WORLD_FILE
from rig.core.samples import ARM_TRUTH, HAND_TRUTH, WORLD_STATE
from rig.core.shared_memory import SharedLatest
from rig.core.stream_settings import StreamSettings
from rig.devices import registry

logger = logging.getLogger(__name__)

# Start height of the arm above the middle of the sensor [m].
_START_HEIGHT = 0.03
_UR_PORTS = (29999, 30001, 30002, 30003, 30004)
# Interpreters start one after the other on a small or busy machine [s].
_READY_TIMEOUT = 90.0
_END_TIMEOUT = 5.0
# The processes share the cores with each other and with the rig: none may use several threads for a
# matrix product, or busy-wait for the others.
_ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1"
)
# Kinds of devices that are emulated.
_KINDS = ("arm", "force", "camera", "taxels", "gripper", "pedal", "spacemouse")
# Time until an emulated hand answers [ms]; assumed.
_MODBUS_MS = 8.0
# Pose of a finger, which nothing uses.
_NOWHERE = {"position_mm": [0.0, 0.0, 0.0]}
# Fault port of the first of the devices that have names of their own.
_NAMED_PORTS = 31020


class ProcessGroup:
    """Group of processes, each running `rig.mock.emulate`; a context manager.

    Everything that was started is closed, even if the start fails half-way. In the run folder,
    `<name>.json` holds the settings of each process, `<name>.log` its stderr.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.processes: dict[str, subprocess.Popen[str]] = {}
        """The processes, by name."""

    def __enter__(self) -> Self:
        try:
            self._start()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _start(self) -> None:
        """Launch the processes, and start what belongs to them."""
        raise NotImplementedError

    def _launch(self, documents: Mapping[str, tuple[str, Mapping[str, Any]]]) -> None:
        """Start emulators with their settings, by process, and wait until each listens."""
        for name, (_, settings) in documents.items():
            (self._folder / f"{name}.json").write_text(json.dumps(settings))
        for name, (emulator, _) in documents.items():
            file = str(self._folder / f"{name}.json")
            command = ["-m", "rig.mock.emulate", emulator, "--file", file, "--until-stdin-closes"]
            with (self._folder / f"{name}.log").open("w") as log:
                self.processes[name] = subprocess.Popen(
                    [sys.executable, *command],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    text=True,
                    env={**os.environ, **_ONE_THREAD},
                    # Ctrl-C is handled by the parent, which ends the processes last.
                    start_new_session=True,
                )
        for name, process in self.processes.items():
            stdout = process.stdout
            if stdout is None:
                raise RuntimeError(f"{name}: started without a pipe")
            with selectors.DefaultSelector() as selector:
                selector.register(stdout, selectors.EVENT_READ)
                line = stdout.readline() if selector.select(_READY_TIMEOUT) else ""
            if not line.startswith("ready"):
                message = self.last_word(name)
                missing = re.match(r"ModuleNotFoundError: No module named '([\w.]+)'", message)
                if missing and (extra := extra_of(missing[1], "rig")):
                    raise ConfigError(
                        f"{name} emulator: {missing[1]} is not installed; install the extra: "
                        f"pip install 'tactile-rig[{extra}]'"
                    )
                raise DeviceLost(f"{name} emulator did not start: {message}; try again")

    def check(self) -> None:
        """Raise if a process has ended by itself."""
        for name, process in self.processes.items():
            if process.poll() is not None:
                message = self.last_word(name)
                raise DeviceLost(
                    f"{name}: its emulator ended (code {process.returncode}): {message}"
                )

    def last_word(self, name: str) -> str:
        """Return the last line that a process wrote to stderr."""
        lines = (self._folder / f"{name}.log").read_text().strip().splitlines()
        return lines[-1] if lines else "no output"

    def close(self) -> None:
        """End all processes; may be called twice."""
        for process in self.processes.values():
            process.terminate()
        for process in self.processes.values():
            try:
                process.wait(_END_TIMEOUT)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    pipe.close()


class MockBench(ProcessGroup):
    """The emulators of one mock bench, with an empty run folder for their shared records."""

    def __init__(
        self,
        file: BenchFile,
        folder: Path,
        *,
        sources: Sources | None = None,
        truth: Path | None = None,
        devices: Collection[str] = _KINDS,
    ) -> None:
        super().__init__(folder)
        self.host = free_loopback()
        self.file = file.at(self.host, folder)
        """The bench with the addresses of the emulators."""
        if self.bench.world is None:
            raise ConfigError(f"{file.path}.world: missing; allowed: a world, on a mock bench")
        self._sources = sources or Sources()
        self._truth = truth
        self._devices = devices
        self._closed = False

    @property
    def bench(self) -> Bench:
        """The bench with the addresses of the emulators."""
        return self.file.bench

    def documents(self) -> dict[str, tuple[str, dict[str, Any]]]:
        """Return the emulator and the settings of each process, by the name of the process."""
        bench, content, folder = self.bench, self.file.content, self._folder
        world = {
            "world": content["world"],
            "contact_frame": content.get("world_frame") or content["contact_frame"],
            "folder": str(folder),
            "indenter": bench.indenter,
            "truth": self._truth and str(self._truth),
            "host": self.host,
            "fault_port": PORTS["world"],
        }
        documents: dict[str, tuple[str, dict[str, Any]]] = {"world": ("world", world)}
        if bench.world is not None and bench.world.tier == "layer":
            documents["solver"] = ("solver", world)
        played: set[str] = set()
        for process, kind, config, section, port in self._emulated():
            if kind not in self._devices:
                continue
            # The first of a kind plays a real recording, if there is one.
            sources = Sources() if kind in played else self._sources
            played.add(kind)
            settings = {
                "device": {"kind": config.KIND, **section},
                "host": self.host,
                "world": str(folder / WORLD_FILE),
                "fault_port": port,
                **self._more(process, kind, config, sources),
            }
            documents[process] = (config.KIND, settings)
        return documents

    def _emulated(self) -> Iterator[tuple[str, str, Any, dict[str, Any], int]]:
        """Yield process, kind, settings, section of the file and fault port of each device."""
        bench, content = self.bench, self.file.content
        for kind in _KINDS:
            key = "jog" if kind == "spacemouse" else kind
            if getattr(bench, key) is not None and not (key == "force" and bench.no_gauge):
                yield kind, kind, getattr(bench, key), content[key], PORTS[kind]
        for number, (name, config) in enumerate((bench.streams or {}).items()):
            section = content["streams"][name]
            if registry.device(config.KIND).emulator or not hasattr(config, "host"):
                yield f"{name}.device", config.STREAM, config, section, _NAMED_PORTS + number
            elif getattr(config, "host", None) != bench.arm.host:
                # The arm's own controller serves further readers.
                raise ConfigError(
                    f"streams.{name}.host: found {section['host']!r}; allowed on a mock bench: "
                    "that of the arm"
                )

    def _more(self, process: str, name: str, config: Any, sources: Sources) -> dict[str, Any]:
        """Return the settings of an emulator that its device does not have."""
        bench, world = self.bench, self.bench.world
        if world is None:
            raise RuntimeError("a mock bench without a world")
        if isinstance(config, StreamSettings):
            try:
                config.check_mock()
            except ValueError as error:
                raise ConfigError(f"{process.removesuffix('.device')}.{error}") from None
        noise, lab, view = world.noise or Noise(), world.lab, str(self._folder / "world.json")
        if name == "arm":
            start = bench.tool_pose((0.0, 0.0, _START_HEIGHT))
            return {
                "state": str(self._folder / ARM_FILE),
                "pose": start.tolist(),
                "wrist": bool(bench.of_kind("arm_wrench")),
                "pose_jitter_mm": lab.pose_jitter_mm,
                "flipped_rotation": lab.flipped_rotation,
            }
        if name == "force":
            return {"noise_n": noise.force}
        if name == "camera":
            if sources.camera is not None:
                return {"source": str(sources.camera), "motion": sources.camera_motion}
            return {"view": view, "delay_ms": from_si(world.delay, "ms")}
        if name == "taxels":
            if sources.taxels is not None:
                return {"source": str(sources.taxels)}
            at = {} if lab.taxel_rate_hz is None else {"true_rate_hz": lab.taxel_rate_hz}
            return {"view": view, "noise": noise.counts} | at
        if name == "gripper":
            return {"holding": True}
        if not config.device.endswith(".hidraw"):
            raise ConfigError(
                f"{name}.device: found {config.device!r}; allowed on a mock bench: "
                f"runfolder/{name}.hidraw"
            )
        return {}

    def _start(self) -> None:
        documents = self.documents()
        SharedLatest.create(self._folder / ARM_FILE, ARM_TRUTH).close()
        SharedLatest.create(self._folder / WORLD_FILE, WORLD_STATE).close()
        self._launch(documents)

    def close(self) -> None:
        """End every emulator; may be called twice."""
        super().close()
        if "solver" in self.processes and not self._closed:
            # The number of solutions shows how accurate the World was.
            logger.info(self.last_word("solver"))
        self._closed = True


class MockHand(ProcessGroup):
    """The emulators of a mock hand: World, both fingers and gripper.

    `truth` is a folder for the states of each finger; None: they are not kept.
    """

    def __init__(self, file: PairFile, folder: Path, *, truth: Path | None = None) -> None:
        super().__init__(folder)
        host = free_loopback()
        self.hosts = {"left": host, "right": free_loopback((host,))}
        """Address of the emulators of each finger; World and gripper are at that of the left."""
        self.file = file.at(self.hosts, folder)
        """The bench with the addresses of the emulators."""
        self._truth = truth

    def _start(self) -> None:
        content, bench, folder = self.file.content, self.file.bench, self._folder
        SharedLatest.create(folder / HAND_FILE, HAND_TRUTH).close()
        worlds = {name: each["world"] for name, each in content["fingers"].items()}
        world = {
            "pair": {**worlds, "compliance": bench.compliance},
            "objects": content["objects"],
            "folder": str(folder),
            "truth": self._truth and str(self._truth),
        }
        gripper = {
            "device": content["gripper"],
            "hand": str(folder / HAND_FILE),
            "world": str(folder / "left.state"),
            "delay_ms": _MODBUS_MS,
        }
        documents = {"world": ("hand", world), "gripper": (bench.gripper.KIND, gripper)}
        for name, (_, settings) in documents.items():
            settings |= {"host": self.hosts["left"], "fault_port": PORTS[name]}
        for side, (name, finger) in enumerate(bench.fingers.items()):
            SharedLatest.create(folder / f"{name}.state", WORLD_STATE).close()
            view, kind = folder / f"{name}-view.json", finger.device.STREAM
            faces = [[each.faces[side], each.friction] for each in bench.objects]
            of_view = {"world": worlds[name], "contact_frame": _NOWHERE, "folder": str(folder)}
            view.write_text(json.dumps({**of_view, "faces": faces}))
            noise = (finger.world and finger.world.noise) or Noise()
            more = {"noise": noise.counts} if kind == "taxels" else {}
            device = {
                "device": content["fingers"][name]["device"],
                "host": self.hosts[name],
                "world": str(folder / f"{name}.state"),
                "view": str(view),
                "fault_port": PORTS[kind],
            }
            documents[name] = (finger.device.KIND, device | more)
        self._launch(documents)


def free_loopback(taken: Collection[str] = ()) -> str:
    """Return a 127.x.y.z address, none of `taken`, without a listener on a UR controller's ports.

    The ports are fixed in the client library, so simultaneous benches need different addresses.
    """
    rng = np.random.default_rng(os.getpid())
    for _ in range(50):
        host = "127." + ".".join(str(number) for number in rng.integers(2, 250, 3))
        if host not in taken and all(_is_free(host, port) for port in _UR_PORTS):
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
