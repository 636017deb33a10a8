"""Processes of a running collection, found in /proc so that they can be killed."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterable
from pathlib import Path

from rig.core.clock import SECOND_NS, SystemClock

_POLL_NS = SECOND_NS // 100


def family(main: int) -> dict[int, str]:
    """Return the command lines of process `main` and all its descendants, by pid."""
    parents: dict[int, int] = {}
    commands: dict[int, str] = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            status = (entry / "stat").read_text()
            command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
        except OSError:
            continue
        pid = int(entry.name)
        parents[pid] = int(status.rsplit(")", 1)[1].split()[1])
        commands[pid] = command
    found = {main}
    while more := {pid for pid, parent in parents.items() if parent in found} - found:
        found |= more
    return {pid: commands[pid] for pid in found if pid in commands}


def stream_process(pids: Iterable[int], session: Path, name: str) -> int:
    """Return the one of `pids` that writes stream `name` of `session`.

    Raises:
        LookupError: None of them writes it.
    """
    folder = f"{session / 'streams' / name}/"
    for pid in pids:
        with contextlib.suppress(OSError):
            for link in Path(f"/proc/{pid}/fd").iterdir():
                with contextlib.suppress(OSError):
                    if os.readlink(link).startswith(folder):
                        return pid
    raise LookupError(f"no process writes {folder}")


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
        status = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
    # A zombie has ended, but its parent has not yet collected its exit status.
    return status.rsplit(")", 1)[1].split()[0] != "Z"
