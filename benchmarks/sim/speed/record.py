"""Measurements of a device: the machine, then one line for every timed run; JSON Lines."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

# Parts in the order of measurement.
PARTS = ("presses", "scaling", "steps", "mpm", "meshes", "reference")


@dataclass(frozen=True, slots=True)
class Machine:
    """Machine of the runs in a file, and its rates."""

    name: str
    device: str
    warm_seconds: float = math.nan
    """Time of the first press with every set of kernels, compiled if necessary, and loaded [s]."""
    compiled: int = 0
    """Number of kernel modules that were compiled; the others were in Warp's cache."""
    copy_rate: float = math.nan
    """Bytes read and written per second when copying an array larger than any cache, with as many
    threads as processes."""
    near_rate: float = math.nan
    """The same with an array as large as the tangent of one press on the timed mesh."""
    flop_rate: float = math.nan
    """Peak float32 operations per second."""
    flop_source: str = ""
    """Source of `flop_rate`."""


@dataclass(frozen=True, slots=True)
class Run:
    """One timed run of some presses."""

    part: str
    name: str
    presses: int = 0
    seconds: float = math.nan
    """Wall time, with kernels compiled before."""
    again: float = math.nan
    """The same for a second run, with memory already allocated."""
    cpu: float = math.nan
    """CPU time of all processes [s]."""
    memory: int = 0
    """Peak memory [bytes]: on a CPU of all processes, including Python and libraries; on a GPU of
    the arrays."""
    processes: int = 1
    spacing_mm: float = math.nan
    tolerance: float = math.nan
    """Residual over force at which states are accepted."""
    failed: int = 0
    """Number of presses without a solution."""
    groups: int = 0
    """Number of mesh topologies, which is the minimum number of launches on a GPU."""
    elements: int = 0
    """Number of elements of all presses together; particles of `mpm`."""
    nodes: int = 0
    newton: int = 0
    """Newton iterations of all presses; time steps of `mpm`."""
    newton_first: float = math.nan
    """Newton iterations of the first depths beyond those of a later depth of the same presses."""
    cg: int = 0
    newton_elements: int = 0
    """Newton iterations times elements, summed over presses."""
    newton_nodes: int = 0
    cg_nodes: int = 0
    against: float = math.nan
    """Wall time of the run that this one is compared with, in the same call [s]."""
    difference: float = math.nan
    """Mean distance of the forces from those of that run, relative to their magnitude."""
    note: str = ""
    machine: str = ""
    """Machine, if it is not that of the file."""

    @property
    def key(self) -> tuple[str, str]:
        """Identity of the measurement."""
        return self.part, self.name

    @property
    def best(self) -> float:
        """Shorter of the two times [s]."""
        return self.seconds if not self.again < self.seconds else self.again

    @property
    def press_seconds(self) -> float:
        """That time for each press [s]; NaN without presses."""
        return self.best / self.presses if self.presses else math.nan


@dataclass(slots=True)
class SpeedRecord:
    """File of one device; every change is written immediately and atomically."""

    path: Path
    machine: Machine
    runs: dict[tuple[str, str], Run] = field(default_factory=dict)

    def put(self, run: Run) -> None:
        """Add a run, or replace the one with the same name."""
        self.runs[run.key] = run
        self.write()

    def write(self) -> None:
        """Write the file."""
        lines = [asdict(self.machine), *(asdict(run) for run in self.runs.values())]
        self.path.parent.mkdir(parents=True, exist_ok=True)
        partial = self.path.with_name(f".{self.path.name}.partial")
        text = "".join(json.dumps(_plain(line)) + "\n" for line in lines)
        partial.write_text(text, encoding="utf-8")
        partial.replace(self.path)

    def get(self, part: str, name: str) -> Run | None:
        """Return the run of that name, or None if it was not measured."""
        return self.runs.get((part, name))

    def of(self, part: str) -> list[Run]:
        """Return all runs of a part, in the order of measurement."""
        return [run for run in self.runs.values() if run.part == part]


def read(path: Path) -> SpeedRecord:
    """Read the record in a file.

    Raises:
        FileNotFoundError: No such file.
        ValueError: Not a record.
    """
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    if not lines or "copy_rate" not in lines[0]:
        raise ValueError(f"{path}: no measurements of speed")
    runs = [Run(**_measured(line)) for line in lines[1:]]
    return SpeedRecord(path, Machine(**_measured(lines[0])), {run.key: run for run in runs})


def _plain(line: dict[str, Any]) -> dict[str, Any]:
    """Replace NaN by null, which JSON can represent, and round to six digits."""
    kept = {}
    for name, value in line.items():
        if not isinstance(value, float):
            kept[name] = value
        else:
            kept[name] = float(f"{value:.6g}") if math.isfinite(value) else None
    return kept


def _measured(line: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in line.items() if value is not None}
