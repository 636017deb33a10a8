"""Sessions as `tactile collect` leaves them, its typed answers, and its printed lines."""

import contextlib
import json
import os
import pty
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from support.sessions import specs

from benchmarks.faults.collection_run import CollectionRun, quick_bench
from recorder import OUTCOMES, SessionWriter, check, faults
from trajectories import Plan, plan_to_json

ROOT = Path(__file__).parents[2]


def patient_bench(folder: Path, sensor: str, *, limits: Any = None, more: str = "") -> Path:
    """Write a quick bench whose parts wait for seconds, as on a busy machine."""
    waits = {"stale_force_ms": 4000.0, "stale_pose_ms": 4000.0, **(limits or {})}
    path = quick_bench(folder, sensor, limits=json.dumps(waits), more=more)
    text = path.read_text().replace("arm: {", "arm: {watchdog_hz: 0.2, ")
    path.write_text(text.replace("preflight: {", "preflight: {timeout: 60.0, "))
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
    """Write a session with `done` of `total` targets pressed, as a collection leaves it."""
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


def page_of(run: CollectionRun) -> str:
    """Return the address of its page, once it is printed."""
    run.until_said("watch it at ")
    address = re.search(r"watch it at (\S+)", run.text)
    assert address is not None
    return address[1]
