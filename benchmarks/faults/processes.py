"""Processes of a running collection, found so that they can be killed or watched."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterable
from pathlib import Path

import psutil

from rig.core.clock import SECOND_NS, SystemClock

_POLL_NS = SECOND_NS // 100


def family(main: int) -> dict[int, str]:
    """Return the command lines of process `main` and all its descendants, by pid."""
    commands: dict[int, str] = {}
    with contextlib.suppress(psutil.NoSuchProcess):
        process = psutil.Process(main)
        for each in (process, *process.children(recursive=True)):
            with contextlib.suppress(psutil.Error):
                commands[each.pid] = " ".join(each.cmdline())
    return commands


def stream_written(pid: int, session: Path) -> str | None:
    """Return the name of the stream of `session` that a process writes; None: none."""
    folder = f"{session.resolve() / 'streams'}/"
    with contextlib.suppress(psutil.Error):
        for file in psutil.Process(pid).open_files():
            path: str = file.path
            if path.startswith(folder):
                return path.removeprefix(folder).split("/")[0]
    return None


def stream_process(pids: Iterable[int], session: Path, name: str) -> int:
    """Return the one of `pids` that writes stream `name` of `session`.

    Raises:
        LookupError: None of them writes it.
    """
    for pid in pids:
        if stream_written(pid, session) == name:
            return pid
    raise LookupError(f"no process writes stream {name} of {session}")


def kill(pids: Iterable[int]) -> None:
    """Send SIGKILL to each process, ignoring those that have ended."""
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def wait_gone(pids: Iterable[int], seconds: float) -> list[int]:
    """Wait until the processes have ended; return those that still run after `seconds` [s]."""
    clock = SystemClock()
    deadline_ns = clock.now_ns() + round(seconds * SECOND_NS)
    left = [pid for pid in pids if _runs(pid)]
    while left and clock.now_ns() < deadline_ns:
        clock.sleep_until(clock.now_ns() + _POLL_NS)
        left = [pid for pid in left if _runs(pid)]
    return left


def _runs(pid: int) -> bool:
    try:
        # A zombie has ended, but its parent has not yet collected its exit status.
        return bool(psutil.Process(pid).status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False
