"""Durations, CPU time, memory and sizes, measured alike by all parts."""

import os
import resource
from collections.abc import Sequence
from pathlib import Path

import numpy as np

# Number of images in a window.
WINDOW = 16


def spread_ms(nanoseconds: Sequence[int]) -> dict[str, float]:
    """Return median, 99th percentile and maximum of durations [ms]; NaN if there are none."""
    values = np.asarray(nanoseconds, np.float64) * 1e-6
    if not len(values):
        return dict.fromkeys(("p50", "p99", "most"), float("nan"))
    p50, p99 = np.percentile(values, [50, 99])
    return {"p50": float(p50), "p99": float(p99), "most": float(values.max())}


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
