"""Shortages of this computer, which explain a device that seems late or lost.

Sources: `/proc/loadavg` and `/proc/meminfo` (proc(5)), and the pressure stall information of Linux
4.20 and newer, the share of the last 10 s in which work waited for a core, for memory or for a disk
(docs.kernel.org/accounting/psi.html).
"""

import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

from rig.core.errors import DeviceLost, combined

PROC = Path("/proc")
# Threads per core that run or wait, and the share of waiting, from which cores are too few.
CROWDED, WAITING = 2.0, 0.5
# Share of waiting for memory and for disks, and of memory that is left, that count as short.
SWAPPING, DISK_WAITING, MEMORY = 0.1, 0.5, 0.05
# A paced loop of ours that is late by this stood still [s].
STALL = 0.15


@dataclass(frozen=True, slots=True)
class Load:
    """State of this computer."""

    threads: float = 0.0
    """Threads that run, or wait for a core or a disk: the mean of the last minute, or now."""
    cores: int = 1
    """Cores that this process may use."""
    memory: float = math.inf
    """Memory that is left [bytes]."""
    memory_all: float = math.inf
    """All memory [bytes]."""
    waits: Mapping[str, float] = field(default_factory=dict)
    """Share of the last 10 s in which work waited for `cpu`, `memory`, `io`; empty if unknown."""

    @classmethod
    def read(cls, proc: Path = PROC) -> Self:
        """Read the state now; values that this kernel lacks count as no load."""
        average = re.match(r"([\d.]+) \S+ \S+ (\d+)/", _text(proc / "loadavg"))
        memory = dict(re.findall(r"(\w+): +(\d+) kB", _text(proc / "meminfo")))
        waits = {}
        for name in ("cpu", "memory", "io"):
            if some := re.search(r"some avg10=([\d.]+)", _text(proc / "pressure" / name)):
                waits[name] = float(some[1]) / 100
        return cls(
            max(map(float, average.groups())) if average else 0.0,
            len(os.sched_getaffinity(0)),
            1024 * float(memory.get("MemAvailable", math.inf)),
            1024 * float(memory.get("MemTotal", math.inf)),
            waits,
        )

    def __str__(self) -> str:
        """Return threads, cores and memory as text."""
        memory = f", {self.memory / 1e9:.1f} GB of memory free" if self.memory < math.inf else ""
        return f"{self.threads:.0f} threads on {self.cores} cores{memory}"

    def shortages(self) -> list[str]:
        """Return the resources that this computer is short of; none if it is not busy."""
        found = []
        crowded = self.threads > CROWDED * self.cores
        if crowded and self.waits.get("cpu", 1.0) >= WAITING:
            found.append(f"{self.threads:.0f} threads want its {self.cores} cores")
        if self.memory < MEMORY * self.memory_all or self.waits.get("memory", 0.0) >= SWAPPING:
            found.append(f"{self.memory / 1e9:.1f} of {self.memory_all / 1e9:.1f} GB are free")
        if (waiting := self.waits.get("io", 0.0)) >= DISK_WAITING:
            found.append(f"its disk keeps programs waiting for {waiting:.0%} of the time")
        return found


def _text(path: Path) -> str:
    """Return the content of a file of the kernel, empty without it."""
    return path.read_text() if path.exists() else ""


def busy(load: Load, stalled: float = 0.0) -> str:
    """Return why this computer is busy, or that a process `stalled` lately [s]; else empty."""
    found = load.shortages()
    if stalled >= STALL:
        found.append(f"a process of ours stood still for {stalled:.1f} s")
    return f"this computer is busy ({', '.join(found)})" if found else ""


def explained(
    error: DeviceLost, *, mock: bool, load: Load | None = None, stalled: float = 0.0
) -> DeviceLost:
    """Return the error of a device that is late or lost, with the busy computer named first.

    A message without anything to check tells the cause already. On a mock bench, whose devices have
    no cables, the message says nothing of what to check.
    `load` is the computer's state, by default the present one; `stalled` as in `busy`.
    """
    each = [str(one) for one in getattr(error, "failures", (error,))]
    short = [problem(text) for text in each]
    if short == each or str(error).startswith("this computer"):
        return error
    first = busy(load or Load.read(), stalled)
    text = str(combined([DeviceLost(text) for text in short]) if mock else error)
    return DeviceLost(f"{first}: {text}" if first else text)


def problem(text: str) -> str:
    """Return what a message `where: problem; what to check` says without what to check."""
    first, *clauses = text.split("; ")
    kept = [clause for clause in clauses if clause.startswith(("allowed", "expected"))]
    return "; ".join([first, *kept])


class Stalls:
    """Times at which a loop of ours, which should turn every `period` [s], stood still."""

    def __init__(self, period: float) -> None:
        self._limit_ns = round((period + STALL) * 1e9)
        self._turned_ns = 0
        self.found: list[tuple[int, int]] = []
        """Beginning and end of each [ns]; the first thousand."""

    def turn(self, now_ns: int) -> None:
        """Note a turn of the loop."""
        before_ns, self._turned_ns = self._turned_ns, now_ns
        if before_ns and now_ns - before_ns > self._limit_ns and len(self.found) < 1000:
            self.found.append((before_ns, now_ns))

    def longest(self, since_ns: int) -> float:
        """Return the longest that ended after a time [s]."""
        lately = (end - start for start, end in reversed(self.found) if end > since_ns)
        return max(lately, default=0) * 1e-9
