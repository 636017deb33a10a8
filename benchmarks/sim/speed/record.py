"""What was measured on a device: the machine, then one line for every timed run; JSON Lines."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

# What is measured, in the order that it is.
PARTS = ("presses", "scaling", "steps", "mpm", "meshes", "reference")


@dataclass(frozen=True, slots=True)
class Machine:
    """Where the runs of a file took place, and how fast that place is."""

    name: str
    device: str
    warm_seconds: float = math.nan
    """First press of every set of kernels: compiled if need be, loaded in any case [s]."""
    compiled: int = 0
    """Kernel modules that were compiled then; the others lay in Warp's cache."""
    copy_rate: float = math.nan
    """Bytes read and written per second when an array larger than any cache is copied, by as many
    threads as processes compute."""
    near_rate: float = math.nan
    """The same with an array as large as the tangent of one press on the mesh that is timed."""
    flop_rate: float = math.nan
    """float32 operations per second at best."""
    flop_source: str = ""
    """Where that comes from."""


@dataclass(frozen=True, slots=True)
class Run:
    """One timed run of some presses."""

    part: str
    name: str
    presses: int = 0
    seconds: float = math.nan
    """Wall time, kernels compiled before."""
    again: float = math.nan
    """The same once more, with the memory already taken."""
    cpu: float = math.nan
    """CPU time of all processes [s]."""
    memory: int = 0
    """Most memory held [bytes]: of all processes, Python and libraries included, on a CPU; of the
    arrays on a GPU."""
    processes: int = 1
    spacing_mm: float = math.nan
    tolerance: float = math.nan
    """Out-of-balance force over force at which states are kept."""
    failed: int = 0
    """Presses without a solution."""
    groups: int = 0
    """Mesh topologies: as many launches at least, on a GPU."""
    elements: int = 0
    """Of all presses together; particles of `mpm`."""
    nodes: int = 0
    newton: int = 0
    """Newton iterations of all presses; time steps of `mpm`."""
    newton_first: float = math.nan
    """How many more of them the first depths took than a later depth of the same presses."""
    cg: int = 0
    newton_elements: int = 0
    """Newton iterations times elements, summed over presses."""
    newton_nodes: int = 0
    cg_nodes: int = 0
    against: float = math.nan
    """Wall time of the run that this one is compared with, in the same call [s]."""
    difference: float = math.nan
    """Mean distance of the forces from those of that run, over their size."""
    note: str = ""

    @property
    def key(self) -> tuple[str, str]:
        """What is measured once."""
        return self.part, self.name

    @property
    def best(self) -> float:
        """The shorter of the two times [s]."""
        return self.seconds if not self.again < self.seconds else self.again


@dataclass(slots=True)
class Record:
    """The file of one device; every change is written at once and whole."""

    path: Path
    machine: Machine
    runs: dict[tuple[str, str], Run] = field(default_factory=dict)

    def put(self, run: Run) -> None:
        """Add a run, or put it in the place of the one of its name."""
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
        """The run of that name, if it was measured."""
        return self.runs.get((part, name))

    def of(self, part: str) -> list[Run]:
        """All runs of a part, in the order in which they were measured."""
        return [run for run in self.runs.values() if run.part == part]


def read(path: Path) -> Record:
    """The record in a file.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is not one.
    """
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    if not lines or "copy_rate" not in lines[0]:
        raise ValueError(f"{path}: no measurements of speed")
    runs = [Run(**_measured(line)) for line in lines[1:]]
    return Record(path, Machine(**_measured(lines[0])), {run.key: run for run in runs})


def _plain(line: dict[str, Any]) -> dict[str, Any]:
    """JSON knows no NaN: null stands for it; six digits are enough."""
    kept = {}
    for name, value in line.items():
        if not isinstance(value, float):
            kept[name] = value
        else:
            kept[name] = float(f"{value:.6g}") if math.isfinite(value) else None
    return kept


def _measured(line: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in line.items() if value is not None}
