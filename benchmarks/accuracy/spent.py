"""Cost of a computation: wall time, CPU time, and peak memory."""

from __future__ import annotations

import resource
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

Value = TypeVar("Value")

# Interval between checks of a GPU's memory [s].
LOOK_EVERY = 2e-3
_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


@dataclass(frozen=True, slots=True)
class Spent:
    """Cost of one computation."""

    wall: float
    """[s]."""
    cpu: float
    """CPU time of all threads [s]."""
    memory: int
    """Peak memory [bytes]: on a CPU of the process, including Python and libraries; on a GPU of the
    arrays."""


def spent_by(work: Callable[[], Value], device: str) -> tuple[Value, Spent]:
    """Return the result of `work`, and its cost on `device`."""
    if device != "cpu":
        return _on_gpu(work, device)
    _forget_peak()
    wall, cpu = time.perf_counter(), time.process_time()
    value = work()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return value, Spent(wall, cpu, peak_memory())


def peak_memory() -> int:
    """Return the peak memory of this process [bytes], since `_forget_peak` where supported.

    Not `ru_maxrss` on Linux, because a child's starts at the value of its parent.
    """
    if _STATUS.exists():
        for line in _STATUS.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def _forget_peak() -> None:
    """Reset the peak memory, if the system allows it."""
    if _CLEAR.exists():
        try:
            _CLEAR.write_text("5")
        except OSError:
            return


def _on_gpu(work: Callable[[], Value], device: str) -> tuple[Value, Spent]:
    """Measure like `spent_by`; the pool's high-water mark cannot be reset, so it is polled."""
    import warp as wp

    wp.synchronize_device(device)
    before = wp.get_mempool_used_mem_current(device)
    most = before
    done = threading.Event()

    def look() -> None:
        nonlocal most
        while not done.wait(LOOK_EVERY):
            most = max(most, wp.get_mempool_used_mem_current(device))

    watcher = threading.Thread(target=look, daemon=True)
    watcher.start()
    try:
        wall, cpu = time.perf_counter(), time.process_time()
        value = work()
        wp.synchronize_device(device)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    finally:
        done.set()
        watcher.join()
    return value, Spent(wall, cpu, int(most - before))
