"""Worker processes on the cores of one machine: how they start, end and are missed."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

from sim.errors import SceneError


class WorkerLost(RuntimeError):
    """A worker process ended without an answer; nothing is known of the scene that it was at."""


def check_processes(processes: int, device: str) -> None:
    """Refuse a number of processes that cannot be.

    Raises:
        SceneError: Not a whole number from 1 up; or several where the device is not the CPU.
    """
    if not isinstance(processes, int) or isinstance(processes, bool) or processes < 1:
        raise SceneError(f"processes: {processes!r}; allowed: whole numbers from 1 up")
    if processes > 1 and device != "cpu":
        raise SceneError(
            f"processes: {processes} on device {device!r}, which solves scenes side by side in one "
            "process; allowed: 1, or device 'cpu'"
        )


def make_ready(tier: str, device: str = "cpu") -> None:
    """Make a worker end with its parent, and start Warp without a banner of its own."""
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()
    if tier != "layer":
        from sim.device import ready_device

        ready_device(device)


def _end_with_parent() -> None:
    """Wait for the parent to die: nobody is left then to stop this process."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


class Spawning(SpawnContext):
    """Starts processes anew, and knows those that it has started."""

    def __init__(self) -> None:
        super().__init__()
        self.started: list[SpawnProcess] = []

    def Process(self, *args: Any, **kwargs: Any) -> SpawnProcess:  # type: ignore[override] # noqa: N802
        """A process that can be stopped later."""
        process = SpawnProcess(*args, **kwargs)
        self.started.append(process)
        return process


@contextlib.contextmanager
def interrupts_kept_off() -> Iterator[None]:
    """Processes and threads begun inside never see Ctrl-C: who began them stops them.

    They inherit what is blocked here; a Ctrl-C that comes meanwhile arrives at the end.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def lost_worker(workers: Sequence[SpawnProcess], done: str) -> str:
    """What became of the workers, as far as their exit codes tell; the others were stopped then.

    `done` is how much had been done, such as "3 of 9 scenes".
    """
    codes = [worker.exitcode or 0 for worker in workers]
    came = f"{done} done"
    for code in codes:
        if code < 0 and code != -signal.SIGTERM:
            reason = ", most likely for lack of memory" if code == -signal.SIGKILL else ""
            return (
                f"a worker process was killed by {signal.Signals(-code).name}{reason}, {came}; "
                "allowed: fewer processes or a coarser mesh"
            )
    return (
        f"a worker process ended with exit code {max(codes)}, {came}; a script that asks for "
        'processes has to do so under if __name__ == "__main__":'
    )
