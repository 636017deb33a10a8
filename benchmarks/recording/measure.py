"""Durations, CPU time, memory and sizes, measured alike by all parts."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import resource
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from rig.core.errors import ConfigError


def spread_ms(nanoseconds: Sequence[int]) -> dict[str, float]:
    """Return median, 99th percentile and maximum of durations [ms]; NaN if there are none."""
    values = np.asarray(nanoseconds, np.float64) * 1e-6
    if not len(values):
        return dict.fromkeys(("p50", "p99", "most"), float("nan"))
    p50, p99 = np.percentile(values, [50, 99])
    return {"p50": float(p50), "p99": float(p99), "most": float(values.max())}


@contextlib.contextmanager
def spawned(target: Callable[..., None], *args: Any) -> Iterator[Connection]:
    """Run `target(*args, pipe)` in a process that ends with the block; yield our end of it."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=target, args=(*args, theirs), daemon=True)
    process.start()
    theirs.close()
    try:
        yield ours
    finally:
        ours.close()
        process.join(5.0)
        if process.is_alive():
            process.kill()
            process.join()
        process.close()


def answer_of(pipe: Connection, timeout: float, title: str) -> Any:
    """Return what a spawned process sends.

    Raises:
        ConfigError: It ended or did not answer.
    """
    with contextlib.suppress(EOFError):
        if pipe.poll(timeout):
            return pipe.recv()
    raise ConfigError(f"{title}: its process ended or did not answer")


def cpu_seconds() -> float:
    """Return the CPU time of this process and its finished children, user and system [s]."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return float(sum(usage.ru_utime + usage.ru_stime for usage in used))


def resident_bytes() -> int:
    """Return the resident memory of this process [bytes]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def files_of(path: Path) -> list[Path]:
    """Return a file, or all files below a folder."""
    return [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]


def tree_bytes(path: Path) -> int:
    """Return the size of a file, or of all files below a folder [bytes]."""
    return sum(file.stat().st_size for file in files_of(path))


def sync_tree(path: Path) -> None:
    """Flush a file, or all files below a folder, to the disk."""
    for file in files_of(path):
        fd = os.open(file, os.O_RDONLY)
        try:
            os.fsync(fd)
        finally:
            os.close(fd)


def warm(path: Path) -> None:
    """Read a file, or all files below a folder, into the page cache."""
    for file in files_of(path):
        with file.open("rb") as content:
            while content.read(1 << 22):
                pass
