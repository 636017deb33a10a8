"""Measures shared by all parts: spreads, sizes, CPU time, and the scale of a run."""

from __future__ import annotations

import os
import resource
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True, slots=True)
class Scale:
    """Durations and sizes of the measurements."""

    write: float
    """Maximum duration of writing one store once [s]."""
    writes: int
    """Number of times that each store is written; the one with the least CPU a frame counts."""
    write_bytes: int
    """Maximum number of pixel or JPEG bytes written to one store."""
    read: float
    """Duration of reading one store [s]."""
    kills: int
    """Number of kills per store."""
    cpu_share: float
    """Duration of recording one stream by itself [s]."""
    lateness: float
    """Duration of measuring wake-ups at one rate [s]."""
    cameras: float
    """Duration of one trial of a number of cameras [s]."""
    cameras_most: int
    """Largest number of cameras tried."""
    full_load: float
    """Duration of recording all streams together [s]."""
    alignment: float
    """Length of the simulated motion [s]."""
    targets: int
    """Number of targets to collect on the mock bench; 0 skips it."""


FULL = Scale(
    write=3.0,
    writes=3,
    write_bytes=400_000_000,
    read=1.5,
    kills=2,
    cpu_share=12.0,
    lateness=3.0,
    cameras=6.0,
    cameras_most=48,
    full_load=120.0,
    alignment=30.0,
    targets=2,
)
# Shows that everything works; its numbers mean little.
QUICK = Scale(
    write=0.3,
    writes=1,
    write_bytes=20_000_000,
    read=0.2,
    kills=1,
    cpu_share=0.6,
    lateness=0.15,
    cameras=0.6,
    cameras_most=2,
    full_load=1.5,
    alignment=3.0,
    targets=0,
)


@dataclass(frozen=True, slots=True)
class Spread:
    """Distribution of a duration [s]."""

    p50: float
    p99: float
    most: float

    @classmethod
    def of(cls, nanoseconds: Sequence[int]) -> Spread:
        """Return the spread of durations (n,) [ns], or NaN if there are none."""
        if not len(nanoseconds):
            return cls(float("nan"), float("nan"), float("nan"))
        values = np.asarray(nanoseconds, np.float64) * 1e-9
        p50, p99 = np.percentile(values, [50, 99])
        return cls(float(p50), float(p99), float(values.max()))


def cpu_seconds() -> float:
    """Return the CPU time of this process and its finished children, user and system [s]."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return float(sum(usage.ru_utime + usage.ru_stime for usage in used))


def resident_bytes() -> int:
    """Return the resident memory of this process [bytes]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def tree_bytes(path: Path) -> int:
    """Return the size of a file, or of all files below a folder [bytes]."""
    if path.is_file():
        return path.stat().st_size
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def sync_tree(path: Path) -> None:
    """Flush a file, or all files below a folder, to disk."""
    for entry in (path, *path.rglob("*")) if path.is_dir() else (path,):
        fd = os.open(entry, os.O_RDONLY)
        try:
            os.fsync(fd)
        finally:
            os.close(fd)


def warm(path: Path) -> None:
    """Read a file, or all files below a folder, into the page cache."""
    for file in path.rglob("*") if path.is_dir() else (path,):
        if file.is_file():
            with file.open("rb") as content:
                while content.read(1 << 22):
                    pass
