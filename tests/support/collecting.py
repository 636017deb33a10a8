"""Run `tactile collect` as a user does, and find its processes to kill them."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from support.sessions import specs

from benchmarks.faults.collection_run import quick_bench
from benchmarks.faults.processes import family, kill, stream_process, wait_gone
from recorder import OUTCOMES, SessionWriter, check, faults
from trajectories import Plan, plan_to_json

ROOT = Path(__file__).parents[2]


def patient_bench(folder: Path, sensor: str, *, limits: Any = None, more: str = "") -> Path:
    """Write a quick bench whose arm and guard wait seconds for what a busy machine delays."""
    waits = {"stale_force_ms": 4000.0, "stale_pose_ms": 4000.0, **(limits or {})}
    path = quick_bench(folder, sensor, limits=json.dumps(waits), more=more)
    path.write_text(path.read_text().replace("arm: {", "arm: {watchdog_hz: 0.2, "))
    return path


def faults_of(session: Path, *, stopped: bool = False) -> list[str]:
    """Return the findings of `check` that a busy machine cannot have caused.

    The emulators share this machine's cores: a delay of 50 ms in one causes a gap, and so does an
    emulated controller whose clock stops in the meantime. Frames and poses that an emulator was too
    late for are never sent: they are lost by arrival or by the controller's clock, never by number.
    The streams of a session that was `stopped` may end before it does.
    """
    excused = {"gap", "clock-step"} | ({"truncated"} if stopped else set())
    return [
        str(finding)
        for finding in faults(check(session))
        if finding.code not in excused
        and (finding.code != "dropped" or "counted by sequence" in finding.message)
    ]


def tactile(*words: object) -> subprocess.CompletedProcess[str]:
    """Run a command without a terminal, as a user does, to its end."""
    return subprocess.run(
        [sys.executable, "-m", "tactile", *map(str, words)],
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )


def pressed_session(
    path: Path, plan: Plan, total: int, done: int, status: str, **attrs: object
) -> None:
    """Write a session with `done` of `total` targets pressed, as a collection leaves it.

    Args:
        path: The session.
        plan: Its plan.
        total: Number of the plan's targets that it is to have.
        done: Number of those pressed.
        status: Status that it ends with.
        attrs: Its other attributes, as `sensor`.
    """
    targets = {
        "point": np.ones(total, np.int16),
        "depth": np.zeros(total),
        "direction": np.zeros(total, np.int16),
        "planned": np.zeros((total, 3)),
    }
    attrs = {"bench": {}, "plan": plan_to_json(plan), "targets_wanted": total, **attrs}
    streams = specs(("force", "pose", "camera"), (48, 64), "jpeg")
    path.parent.mkdir(exist_ok=True)
    with SessionWriter.create(path, attrs=attrs, streams=streams, targets=targets) as writer:
        writer.begin_run({"t0_ns": 0})
        for target in list(plan.targets())[:done]:
            for move in plan.moves(target):
                start_ns = 1 + move.phase + 10 * target.index
                row = {"target": target.index, "phase": move.phase, "run": 0}
                row |= {"outcome": OUTCOMES.index("complete")}
                writer.segments.append(**row, start_ns=start_ns, end_ns=start_ns + 1)
        writer.finish(status, rate_hz=40.0)


@contextlib.contextmanager
def move_typed() -> Iterator[int]:
    """Yield a terminal to use as standard input, on which `move` is typed until it is read."""
    master, slave = pty.openpty()
    over = threading.Event()

    def type_on() -> None:
        # What is typed before a question does not answer it.
        while not over.wait(0.3):
            os.write(master, b"move\n")

    typing = threading.Thread(target=type_on)
    typing.start()
    try:
        yield slave
    finally:
        over.set()
        typing.join()
        os.close(master)
        os.close(slave)


@dataclass
class Collection:
    """One running collection."""

    session: Path
    process: subprocess.Popen[str]
    lines: list[str] = field(default_factory=list)

    @classmethod
    def start(
        cls, session: Path, *arguments: str, sensor: str = "tacpalm", stdin: int | None = None
    ) -> Collection:
        where = [] if "--resume" in arguments else ["--out", str(session)]
        if "--bench" not in arguments and "--resume" not in arguments:
            where += ["--sensor", sensor]
        # Ignore calibrations of mock benches that were measured on this machine.
        where += ["--calibrations", str(session.parent / "none-measured")]
        return cls.of_command(session, "collect", *where, *arguments, stdin=stdin)

    @classmethod
    def of_command(cls, session: Path, *words: str, stdin: int | None = None) -> Collection:
        """Start a command that records `session`."""
        process = subprocess.Popen(
            [sys.executable, "-u", "-m", "tactile", *words],
            cwd=ROOT,
            stdin=stdin,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        return cls(session, process)

    def page(self) -> str:
        """Return the address of its page, once it is printed."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line.rstrip())
            if address := re.search(r"watch it at (\S+)", line):
                return address[1]
        raise AssertionError(f"no address was printed:\n{self.text}")

    def wait(self, timeout: float = 240.0) -> int:
        """Return its exit code, with all printed lines in `lines`."""
        try:
            output, _ = self.process.communicate(timeout=timeout)
        except subprocess.TimeoutExpired:
            self.kill_all()
            output, _ = self.process.communicate()
            raise AssertionError(f"hangs after:\n{output}") from None
        self.lines += output.splitlines()
        return self.process.returncode

    @property
    def text(self) -> str:
        return "\n".join(self.lines)

    def processes(self) -> dict[int, str]:
        """Return the command lines of its processes, including the main one, by pid."""
        return family(self.process.pid)

    def emulator(self, name: str) -> int:
        """Return the pid of the emulator of a device, of the World, or of a replayed stream."""
        commands = self.processes()
        return next(pid for pid in commands if f"/{name}.json" in commands[pid])

    def host(self) -> str:
        """Return the loopback address of the mock bench."""
        command = self.processes()[self.emulator("arm")].split()
        return str(json.loads(Path(command[command.index("--file") + 1]).read_text())["host"])

    def stream(self, name: str) -> int:
        """Return the pid of the process that writes `<session>/streams/<name>`."""
        return stream_process(self.processes(), self.session, name)

    def until(self, condition: Callable[[], bool], timeout: float = 240.0) -> None:
        """Wait for `condition` while the collection runs."""
        deadline = time.monotonic() + timeout
        while not condition():
            if self.process.poll() is not None or time.monotonic() > deadline:
                self.kill_all()
                output, _ = self.process.communicate()
                raise AssertionError(f"it did not come so far:\n{output}")
            time.sleep(0.02)

    def recording(self) -> bool:
        """Return True if frames, poses and forces are being stored."""
        return any(self.session.glob("streams/*/value/c/*/*/*.partial")) or any(
            self.session.glob("streams/force/t_ns/journal-*")
        )

    def segments(self) -> int:
        """Return the bytes of the segment journal, which grows by one row per phase."""
        return sum(path.stat().st_size for path in self.session.glob("segments/*/journal-*"))

    def end(self) -> None:
        """Kill it if it still runs, and close its output; may be called twice."""
        if self.process.poll() is None:
            self.kill_all()
        self.process.wait()
        if self.process.stdout is not None:
            self.process.stdout.close()

    def kill_all(self) -> None:
        """Send SIGKILL to every process, children first, main process last."""
        pids = sorted(self.processes(), key=lambda pid: pid == self.process.pid)
        kill(pids)
        wait_gone((pid for pid in pids if pid != self.process.pid), 10.0)
