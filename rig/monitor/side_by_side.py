"""Forces of one or more sensors at once, each predicted by a process of its own.

    with SideBySide(jobs) as sensors:
        sensors.begin()
        while not sensors.over:
            for force in sensors.forces(timeout=0.1):
                ...  # a FingerForce of one of them

All sensors begin together once each model is loaded, so that sessions are played side by side.
"""

from __future__ import annotations

import contextlib
import gc
import multiprocessing
import signal
import tempfile
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from recorder.errors import SessionError
from rig.core.clock import Clock, SystemClock
from rig.core.errors import ConfigError, DeviceLost
from rig.core.finger import FingerForce
from rig.core.realtime import LIVE_PRIORITY, take_priority
from rig.monitor.forces import Summary, add_gauge, watch
from rig.monitor.forces_page import finger_force
from rig.monitor.predictor import open_predictor
from rig.monitor.watched import Triple, Watched

if TYPE_CHECKING:
    from rig.monitor.predictor import LiveForce

# Longest time in which a process ends by itself [s].
_END_TIMEOUT = 10.0


@dataclass(frozen=True, slots=True)
class SensorJob:
    """A sensor and its model; all of it can be sent to a process."""

    name: str
    """Name of the sensor beside others, such as `left`."""
    open: Callable[[Path, Clock], AbstractContextManager[Watched]]
    """Opens it, with a folder for the files of a mock bench."""
    predictor: dict[str, Any]
    """Arguments of `open_predictor`."""
    seconds: float | None = None
    """Duration [s]; None: until the frames end, or `stop`."""
    out: Path | None = None
    """CSV of its forces, that must not exist."""


# Name of a sensor, and the arguments of `show` (`watch`).
Felt = tuple[str, "LiveForce", int, float, "Triple | None"]


class End(NamedTuple):
    """Results of a sensor: its last lines, true forces [N] by time [ns], why it was lost."""

    lines: list[str]
    true: dict[int, list[float]]
    lost: str = ""


class SideBySide:
    """Context manager of the processes; `warn` gets the name of a sensor and a warning about it.

    Raises:
        ConfigError: A model does not fit its sensor, or a sensor cannot be opened.
        DeviceLost: A device does not answer.
    """

    def __init__(
        self, jobs: Sequence[SensorJob], warn: Callable[[str, str], None] = lambda *_: None
    ) -> None:
        context = multiprocessing.get_context("spawn")
        self.ends: dict[str, End] = {}
        """Results of the sensors that have ended, by name."""
        self._warn, self._pipes, self._processes = warn, dict[Connection, str](), []
        for job in jobs:
            pipe, far_end = context.Pipe()
            self._pipes[pipe] = job.name
            self._processes.append((context.Process(target=_run, args=(job, far_end)), far_end))

    @property
    def over(self) -> bool:
        """True once all sensors have ended."""
        return not self._pipes

    def __enter__(self) -> SideBySide:
        for process, far_end in self._processes:
            process.start()
            far_end.close()
        loading = set(self._pipes)
        try:
            while loading := loading & self._pipes.keys():
                loading -= {pipe for pipe, _ in self._received(None)}
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        for process, _far_end in self._processes:
            process.join(_END_TIMEOUT)
            process.kill()
            process.join()

    def begin(self) -> None:
        """Let all sensors begin."""
        self._send(SystemClock().now_ns())

    def stop(self) -> None:
        """Ask the processes to end; their last forces are still to be read."""
        self._send(None)

    def _send(self, start_ns: int | None) -> None:
        for pipe in self._pipes:
            with contextlib.suppress(OSError):
                pipe.send(start_ns)

    def news(self, timeout: float) -> list[Felt]:
        """Return the forces that have come since, or wait for one for a time [s]."""
        return [content for _, content in self._received(timeout) if type(content) is tuple]

    def forces(self, timeout: float) -> list[FingerForce]:
        """Return `news` as forces of fingers, in the order in which they came."""
        return [finger_force(name, t_ns, reading) for name, reading, t_ns, *_ in self.news(timeout)]

    def _received(self, timeout: float | None) -> list[tuple[Any, Any]]:
        received = []
        for pipe in wait(list(self._pipes), timeout):
            assert isinstance(pipe, Connection)
            try:
                while pipe in self._pipes and pipe.poll():
                    received.append((pipe, self._read(pipe, pipe.recv())))
            except (EOFError, ConnectionResetError):
                self._read(pipe, End([], {}, "its process is gone"))
        return received

    def _read(self, pipe: Connection, content: Any) -> Any:
        """Return a force, or an empty text if the model is loaded; treat all else."""
        name = self._pipes[pipe]
        if isinstance(content, End):
            self.ends[name] = content
            del self._pipes[pipe]
        elif isinstance(content, Exception):
            raise type(content)(f"{name}: {content}" if name else str(content))
        elif isinstance(content, str) and content:
            self._warn(name, content)
        return content


def _run(job: SensorJob, pipe: Connection) -> None:
    """Predict the forces of a sensor in a process of its own."""
    # Ctrl-C is handled by the command, which ends this process through the pipe.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(BrokenPipeError):
        try:
            pipe.send(_watched(job, pipe))
        except (ConfigError, DeviceLost, SessionError) as error:
            pipe.send(error)


def _watched(job: SensorJob, pipe: Connection) -> End:
    """Send the forces of a sensor, and return its results."""
    clock, summary, lost, wrench = SystemClock(), Summary(), "", None
    predictor = open_predictor(warn=pipe.send, **job.predictor)
    with (
        tempfile.TemporaryDirectory(prefix="tactile-rig-") as folder,
        job.open(Path(folder), clock) as watched,
    ):
        pipe.send("")
        if (start_ns := pipe.recv()) is None:
            return End([], {})
        watched.start(start_ns)
        gc.freeze()
        take_priority(LIVE_PRIORITY)
        try:
            watch(
                watched,
                predictor,
                clock,
                summary=summary,
                show=lambda *shown: pipe.send((job.name, *shown)),
                is_over=pipe.poll,
                seconds=job.seconds,
                out=job.out,
            )
        except DeviceLost as error:
            lost = str(error)
        if watched.wrench is not None and summary.frames:
            wrench = watched.wrench(np.array(summary.shows_ns, np.int64))
    lines, true = list(summary.lines(wrench)), {}
    if wrench is not None:
        true = dict(zip(summary.shows_ns, wrench[:, :3].tolist(), strict=True))
        if job.out is not None and np.isfinite(wrench[:, :3]).any():
            add_gauge(job.out, wrench)
    if job.out is not None:
        lines.append(f"{job.out}: {summary.frames:,} forces")
    return End(lines, true, lost)
