"""One command that records on a mock bench, run as a technician runs it; its processes, its bench.

Faults are injected into its devices, and its processes are killed or watched.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks.faults.observer import Observed, Observer
from recorder import OUTCOMES, Session
from rig.core import emulation
from rig.core.clock import SECOND_NS, SystemClock
from rig.core.mock_names import PORTS
from rig.core.packaged import BENCHES

_ROOT = Path(__file__).parents[2]
# Interpreters start one after the other on a small machine [s].
_STARTING = 240.0
_POLL_NS = SECOND_NS // 50


def quick_bench(folder: Path, sensor: str, limits: str = "{}", more: str = "") -> Path:
    """Write a mock bench with a short preflight and fast travel through free space.

    It extends the packaged bench of `sensor`; `limits` is YAML merged over its limits, and `more`
    is YAML to add, in which BENCHES is replaced by the folder of the packaged benches.
    """
    path = folder / "bench.yaml"
    path.write_text(
        f"""
extends: {BENCHES / f"{sensor}.yaml"}
preflight: {{rate_window: 0.4, tare_window: 0.2, point_window: 0.1}}
arm: {{travel_speed_mm_s: 100.0, travel_acceleration_mm_s2: 1000.0}}
limits: {limits}
{more.replace("BENCHES", str(BENCHES))}
"""
    )
    return path


class Hangs(Exception):
    """Raised if a command does not end or reach a stage, with its output."""


class CollectionRun:
    """Context manager of a running command, which ends all its processes on exit.

    It records `session`. Methods that wait raise Hangs if the command ended, or too much time
    passed; it is then killed. `preload` is a library to preload, for devices that need a device
    node of the kernel.
    """

    def __init__(
        self, session: Path, *words: str, stdin: int | None = None, preload: Path | None = None
    ) -> None:
        self.session = session
        self.lines: list[str] = []
        """Lines of output."""
        self._times: list[int] = []
        self.injected_ns: int | None = None
        """Time of the fault [ns]."""
        self.ended_ns = 0
        """Time at which it ended [ns]."""
        self._clock = SystemClock()
        self._observer: Observer | None = None
        # Every process that was ever seen.
        self._processes: set[psutil.Process] = set()
        self.host = ""
        """Address of the mock bench, once it runs."""
        self.folder: Path | None = None
        """Run folder, once the bench runs."""
        self.process = subprocess.Popen(
            [sys.executable, "-u", "-m", "tactile", *words],
            cwd=_ROOT,
            stdin=stdin,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
            env=None if preload is None else {**os.environ, "LD_PRELOAD": str(preload)},
        )
        self._reader = threading.Thread(target=self._read, name="trial-output", daemon=True)
        self._reader.start()

    @classmethod
    def collect(cls, session: Path, *arguments: str, **others: Any) -> CollectionRun:
        """Collect a session, or resume it with the argument `--resume`."""
        out = () if "--resume" in arguments else ("--out", str(session))
        # Calibrations of mock benches that were measured on this machine do not count.
        none = ("--calibrations", str(session.parent / "none-measured"))
        return cls(session, "collect", *out, *none, *arguments, **others)

    def __enter__(self) -> CollectionRun:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill_all()
        self.observed()
        if self.folder is not None:
            # A command that was killed leaves it.
            shutil.rmtree(self.folder, ignore_errors=True)

    def _read(self) -> None:
        if self.process.stdout is not None:
            with self.process.stdout as lines:
                for line in lines:
                    self._times.append(self._clock.now_ns())
                    self.lines.append(line.rstrip("\n"))

    @property
    def text(self) -> str:
        """Complete output."""
        return "\n".join(self.lines)

    @property
    def last_line(self) -> str:
        """Last line of output."""
        return self.lines[-1] if self.lines else ""

    def until(self, condition: Callable[[], bool], what: str, timeout: float = _STARTING) -> None:
        """Wait up to `timeout` [s] for `condition`, with the command still running."""
        deadline_ns = self._clock.now_ns() + round(timeout * SECOND_NS)
        while not condition():
            if self.process.poll() is not None or self._clock.now_ns() > deadline_ns:
                self.kill_all()
                raise Hangs(f"{what}: not reached:\n{self.text}")
            self._clock.sleep_until(self._clock.now_ns() + _POLL_NS)

    def until_said(self, words: str, after: str = "") -> None:
        """Wait until it has printed `words`, after the first `after`."""
        self.until(
            lambda: words in self.text[self.text.find(after) :] and after in self.text, words
        )

    def until_bench(self) -> None:
        """Wait until the mock bench runs."""
        self.until(self._find_bench, "the mock bench")

    def until_recording(self) -> None:
        """Wait until every stream of this run has stored a row, and observe it from then on."""
        self.until_bench()
        assert self.folder is not None
        self._observer = Observer(self.folder, self.host)
        rows = self._observer.observed.rows
        self.until(lambda: all(rows.get(name, 0) for name in ("force", "pose")), "recording")

    def until_pressing(self) -> None:
        """Wait until the first phase of this session has ended and the next one has begun."""
        self.until(lambda: self.segments() > 0, "the first phase")

    def segments(self) -> int:
        """Return the bytes of the segment journal, which grows by one row per phase."""
        return sum(path.stat().st_size for path in self.session.glob("segments/*/journal-*"))

    def _find_bench(self) -> bool:
        for command in self.processes().values():
            if file := re.search(r"--file (\S+/arm\.json)", command):
                self.folder = Path(file[1]).parent
                self.host = json.loads(Path(file[1]).read_text())["host"]
                return True
        return False

    def processes(self) -> dict[int, str]:
        """Return the command lines of its processes by pid, including the main one."""
        commands: dict[int, str] = {}
        with contextlib.suppress(psutil.NoSuchProcess):
            main = psutil.Process(self.process.pid)
            for each in (main, *main.children(recursive=True)):
                with contextlib.suppress(psutil.Error):
                    commands[each.pid] = " ".join(each.cmdline())
                    self._processes.add(each)
        return commands

    def roles(self) -> dict[int, str]:
        """Return what each process does by pid, as `force stream`, `arm` or `arm emulator`."""
        return {pid: self._role(pid, command) for pid, command in self.processes().items()}

    def _role(self, pid: int, command: str) -> str:
        if pid == self.process.pid:
            return "collect"
        if emulator := re.search(r"-m rig\.mock\.emulate .*/(\w+)\.json", command):
            return "World" if emulator[1] == "world" else f"{emulator[1]} emulator"
        if "multiprocessing.spawn" not in command:
            return ""
        with contextlib.suppress(psutil.Error):
            for file in psutil.Process(pid).open_files():
                if stream := re.match(rf"{self.session.resolve()}/streams/(\w+)/", file.path):
                    return f"{stream[1]} stream"
        # A stream opens its files some seconds after its start.
        return "arm"

    def process_of(self, role: str) -> int:
        """Return the pid of a process by its role; LookupError if none has it."""
        for pid, each in self.roles().items():
            if each == role:
                return pid
        raise LookupError(f"no {role} runs")

    def kill(self, *pids: int, by: signal.Signals = signal.SIGKILL) -> None:
        """Send a signal to processes as the fault of this trial."""
        self.processes()
        self.injected_ns = self._clock.now_ns()
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, by)

    def inject(self, device: str, fault: str, **values: Any) -> dict[str, Any]:
        """Inject a fault through the device's fault port and return the device's state."""
        self.injected_ns = self._clock.now_ns()
        return self.tell(device, fault, **values)

    def tell(self, device: str, what: str, **values: Any) -> dict[str, Any]:
        """Send a command that is no fault through the device's fault port."""
        return emulation.inject(self.host, PORTS[device], what, **values)

    def wait(self, timeout: float = 240.0) -> int:
        """Wait for the end, up to `timeout` [s], and return the exit code."""
        try:
            code = self.process.wait(timeout)
        except subprocess.TimeoutExpired:
            self.kill_all()
            raise Hangs(f"no end within {timeout:g} s:\n{self.text}") from None
        self.ended_ns = self._clock.now_ns()
        self._reader.join(5.0)
        return code

    def observed(self) -> Observed:
        """End the observation and return it."""
        return Observed() if self._observer is None else self._observer.close()

    def noticed(self) -> float | None:
        """Return the time from the fault to the end of the phase that it ended [s].

        If it ended no phase, use the line that gives the reason for stopping; None without either.
        """
        if self.injected_ns is None:
            return None
        segments = Session(self.session).segments
        ended = [OUTCOMES.index(outcome) for outcome in ("stopped", "interrupted")]
        stopped = segments["end_ns"][np.isin(segments["outcome"], ended)]
        printed = zip(self._times, self.lines, strict=False)
        reported = [t_ns for t_ns, line in printed if "stopping: " in line]
        after = [int(t_ns) for t_ns in (*stopped, *reported) if t_ns >= self.injected_ns]
        return (min(after) - self.injected_ns) / SECOND_NS if after else None

    def left(self, seconds: float) -> list[psutil.Process]:
        """Wait up to `seconds` [s] until all its processes have ended; return those that run."""
        deadline_ns = self._clock.now_ns() + round(seconds * SECOND_NS)
        while left := [each for each in self._processes if _runs(each)]:
            if self._clock.now_ns() > deadline_ns:
                break
            self._clock.sleep_until(self._clock.now_ns() + _POLL_NS)
        return left

    def kill_all(self) -> None:
        """Send SIGKILL to every process, the main one last, and wait until they end."""
        self.processes()
        main = self.process.pid
        for each in sorted(self.left(0.0), key=lambda each: bool(each.pid == main)):
            with contextlib.suppress(psutil.NoSuchProcess):
                each.kill()
        self.process.wait()
        self.left(10.0)
        self._reader.join(5.0)


def _runs(process: psutil.Process) -> bool:
    try:
        # A zombie has ended, but its parent has not yet collected its exit status.
        return bool(process.is_running() and process.status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False
