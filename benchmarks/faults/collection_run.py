"""One collection on a mock bench, run as a technician runs it, for fault injection."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.faults.observer import Observed, Observer
from benchmarks.faults.processes import family, kill, stream_process, wait_gone
from recorder import OUTCOMES, Session
from rig.core import emulation
from rig.core.clock import SECOND_NS, SystemClock
from rig.core.mock_names import PORTS
from rig.core.packaged import BENCHES

# Emulator of each device, as `rig.mock.emulate` names it.
EMULATORS = {
    "arm": "ur",
    "force": "netft",
    "camera": "camera",
    "taxels": "xela",
    "NI-DAQ": "nidaq",
    "gripper": "robotiq_2f",
    "pedal": "hid_pedal",
    "world": "world",
}
# Devices whose fault port is that of another device.
_LINES = {"NI-DAQ": "force"}

# Interpreters start one after the other on a small machine [s].
_STARTING = 60.0
_POLL_NS = SECOND_NS // 50


def quick_bench(folder: Path, sensor: str, *, limits: str = "{}", more: str = "") -> Path:
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
    """Raised if a collection does not end or reach a stage, with its output."""


class CollectionRun:
    """Context manager of a running collection, which ends all its processes on exit.

    `preload` is a library to preload, for devices that need a device node of the kernel. Methods
    that wait raise Hangs if the collection ended, or too much time passed.
    """

    def __init__(self, session: Path, *arguments: str, preload: Path | None = None) -> None:
        self.session = session
        self.lines: list[tuple[int, str]] = []
        """Lines of output, with the time of each [ns]."""
        self.injected_ns: int | None = None
        """Time of the fault [ns]."""
        self.ended_ns = 0
        """Time at which the process had ended [ns]."""
        self._clock = SystemClock()
        self._observer: Observer | None = None
        self._known: dict[int, str] = {}
        self.host = ""
        """Address of the mock bench, once it runs."""
        self.folder: Path | None = None
        """Run folder, once the bench runs."""
        where = [] if "--resume" in arguments else ["--out", str(session)]
        # Faults do not depend on measured calibrations of the bench.
        where += ["--calibrations", str(session.parent / "none-measured")]
        self.process = subprocess.Popen(
            [sys.executable, "-u", "-m", "tactile", "collect", *where, *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
            env=None if preload is None else {**os.environ, "LD_PRELOAD": str(preload)},
        )
        self._reader = threading.Thread(target=self._read, name="trial-output", daemon=True)
        self._reader.start()

    def __enter__(self) -> CollectionRun:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill_all()
        if self._observer is not None:
            self._observer.close()
        self.process.wait()
        self._reader.join()
        if self.process.stdout is not None:
            self.process.stdout.close()

    def _read(self) -> None:
        if self.process.stdout is not None:
            for line in self.process.stdout:
                self.lines.append((self._clock.now_ns(), line.rstrip("\n")))

    @property
    def text(self) -> str:
        """Complete output."""
        return "\n".join(line for _, line in self.lines)

    @property
    def last_line(self) -> str:
        """Last line of output."""
        return self.lines[-1][1] if self.lines else ""

    def until(self, condition: Callable[[], bool], what: str, timeout: float = _STARTING) -> None:
        """Wait up to `timeout` [s] for `condition`, with the collection still running."""
        deadline_ns = self._clock.now_ns() + round(timeout * SECOND_NS)
        while not condition():
            ended = self.process.poll() is not None
            if ended or self._clock.now_ns() > deadline_ns:
                if ended:
                    self._reader.join(2.0)
                raise Hangs(f"{what}: not reached:\n{self.text}")
            self._clock.sleep_until(self._clock.now_ns() + _POLL_NS)

    def until_recording(self) -> None:
        """Wait until every stream of this run has stored a row, and observe it from then on."""
        self.until(self._find_bench, "the mock bench")
        if self.folder is None:
            raise Hangs(f"no run folder:\n{self.text}")
        observer = self._observer = Observer(self.folder, self.host)
        self.until(lambda: min(observer.rows(name) for name in ("force", "pose")) > 0, "recording")

    def until_pressing(self, before: Callable[[CollectionRun], None] | None = None) -> None:
        """Wait until the first phase of this session has ended and the next one has begun.

        `before` is the operator's action after recording starts, without which nothing is pressed.
        """
        self.until_recording()
        if before is not None:
            before(self)
        self.until(lambda: self._segment_bytes() > 0, "the first phase")

    def _segment_bytes(self) -> int:
        return sum(path.stat().st_size for path in self.session.glob("segments/*/journal-*"))

    def _find_bench(self) -> bool:
        for command in self.processes().values():
            if found := re.search(r"-m rig\.mock\.emulate ur --file (\S+)/arm\.json", command):
                self.folder = Path(found[1])
                self.host = json.loads((self.folder / "arm.json").read_text())["host"]
                return True
        return False

    def processes(self) -> dict[int, str]:
        """Return the command lines of its processes by pid, including the main one."""
        found = family(self.process.pid)
        self._known |= found
        return found

    def emulator(self, device: str) -> int:
        """Return the pid of a device's emulator; LookupError if it is not running."""
        for pid, command in self.processes().items():
            if f"-m rig.mock.emulate {EMULATORS[device]} " in command:
                return pid
        raise LookupError(f"no emulator of the {device} runs")

    def stream(self, name: str) -> int:
        """Return the pid of the process that writes a stream; LookupError if there is none."""
        return stream_process(self.processes(), self.session, name)

    def kill(self, *pids: int) -> None:
        """Send SIGKILL as the fault of this trial."""
        self.processes()
        self.injected_ns = self._clock.now_ns()
        kill(pids)

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to the main process as the fault of this trial."""
        self.injected_ns = self._clock.now_ns()
        os.kill(self.process.pid, number)

    def inject(self, device: str, fault: str, **values: Any) -> dict[str, Any]:
        """Inject a fault through the device's fault port and return the device's state."""
        self.injected_ns = self._clock.now_ns()
        return self.tell(device, fault, **values)

    def tell(self, device: str, what: str, **values: Any) -> dict[str, Any]:
        """Send a command that is no fault through the device's fault port."""
        port = PORTS[_LINES.get(device, device)]
        return emulation.inject(self.host, port, what, **values)

    def until_said(self, words: str, after: str = "") -> None:
        """Wait until it has printed `words`, after the first `after`."""
        self.until(
            lambda: words in self.text[self.text.find(after) :] and after in self.text, words
        )

    def wait(self, timeout: float = 60.0) -> int:
        """Wait for the end, up to `timeout` [s], and return the exit code."""
        try:
            code = self.process.wait(timeout)
        except subprocess.TimeoutExpired:
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
        reported = [t_ns for t_ns, line in self.lines if "stopping: " in line]
        after = [int(t_ns) for t_ns in (*stopped, *reported) if t_ns >= self.injected_ns]
        return (min(after) - self.injected_ns) / SECOND_NS if after else None

    def kill_all(self) -> None:
        """Send SIGKILL to every process, the main one last, and wait until they end."""
        self.processes()
        pids = sorted(self.left(), key=lambda pid: pid == self.process.pid)
        kill(pids)
        wait_gone((pid for pid in pids if pid != self.process.pid), 10.0)

    def left(self) -> list[int]:
        """Return the processes, of all that were ever observed, that still run."""
        return [pid for pid, command in self._known.items() if family(pid).get(pid) == command]
