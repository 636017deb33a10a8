"""Cost of a computation: wall time, CPU time, and peak memory."""

import resource
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import warp as wp

Value = TypeVar("Value")

# Depth of the press that loads the kernels before a measurement [m].
WARM = 0.02e-3


@dataclass(slots=True)
class Spent:
    """Cost of one computation."""

    wall: float = 0.0
    """[s]."""
    cpu: float = 0.0
    """CPU time of all threads [s]."""
    memory: int = 0
    """Peak memory [bytes]: on a CPU of the process, including Python and libraries; on a GPU of the
    arrays."""


def spent_by(work: Callable[[], Value], device: str) -> tuple[Value, Spent]:
    """Return the result of `work`, and its cost on `device`."""
    spent = Spent()
    with _process_peak(spent) if device == "cpu" else _arrays_peak(spent, device):
        wall, cpu = time.perf_counter(), time.process_time()
        value = work()
        if device != "cpu":
            wp.synchronize_device(device)
        spent.wall, spent.cpu = time.perf_counter() - wall, time.process_time() - cpu
    return value, spent


@contextmanager
def _process_peak(spent: Spent) -> Iterator[None]:
    """Measure the peak memory of this process, from now on if the system can reset it."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    yield
    spent.memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    for line in Path("/proc/self/status").read_text().splitlines():
        # Where there is one: `ru_maxrss` of a child starts at the value of its parent.
        if line.startswith("VmHWM:"):
            spent.memory = int(line.split()[1]) * 1024


@contextmanager
def _arrays_peak(spent: Spent, device: str) -> Iterator[None]:
    """Poll the memory of a GPU's arrays, since the pool's high-water mark cannot be reset."""
    wp.synchronize_device(device)
    before = wp.get_mempool_used_mem_current(device)
    done = threading.Event()

    def look() -> None:
        while not done.wait(2e-3):
            used = wp.get_mempool_used_mem_current(device) - before
            spent.memory = max(spent.memory, int(used))

    watcher = threading.Thread(target=look, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        done.set()
        watcher.join()
