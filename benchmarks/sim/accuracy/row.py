"""One measurement of a competitor on a case, and the file of measurements."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

# Errors of a row, largest over frames and axes: N, 1, 1, m, m, m, px, px.
MEASURES = (
    "force",
    "force_share",
    "force_last",
    "surface",
    "surface_rms",
    "outside",
    "marker",
    "marker_rms",
)


@dataclass(frozen=True, slots=True)
class Row:
    """Result of one competitor on one case, or the reason for its absence."""

    case: str
    ladder: str
    label: str
    fineness: float
    device: str
    wall: float = math.nan
    """Wall time of a press [s], kernels compiled before; for several scenes, the mean."""
    cpu: float = math.nan
    """CPU time of a press [s]."""
    memory: int = 0
    """Peak memory [bytes]; see `Spent`."""
    elements: int = 0
    """Number of elements, particles, or pixels."""
    mean: dict[str, float] = field(default_factory=dict)
    """Errors, averaged over the scenes of the case."""
    worst: dict[str, float] = field(default_factory=dict)
    """Errors of the worst scene."""
    axes: tuple[float, ...] = ()
    """Largest error of Fx, Fy and Fz over frames and scenes [N]."""
    failed: int = 0
    """Number of scenes without a solution."""
    note: str = ""
    """Reason for a missing or incomplete result."""

    @property
    def name(self) -> str:
        """Ladder and step."""
        return f"{self.ladder} {self.label}".strip()

    @property
    def key(self) -> tuple[str, str, str]:
        """Identity of the measurement."""
        return self.case, self.name, self.device


@dataclass(frozen=True, slots=True)
class Measured:
    """Rows of one device, its machine, and the reference."""

    machine: str
    device: str
    reference: str
    bounds: dict[str, dict[str, float]]
    """Uncertainty of the reference in each error, by case."""
    rows: tuple[Row, ...]


def begin(path: Path, machine: str, device: str, reference: str) -> None:
    """Create a file of measurements, unless it exists."""
    if path.exists():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    head = {"machine": machine, "device": device, "reference": reference}
    path.write_text(json.dumps(head) + "\n", encoding="utf-8")


def append(path: Path, line: Row | dict[str, Any]) -> None:
    """Append a row, or the reference uncertainty of a case, to a file of measurements."""
    plain = asdict(line) if isinstance(line, Row) else line
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(_without_nan(plain)) + "\n")


def read(path: Path) -> Measured:
    """Read a file of measurements.

    Raises:
        FileNotFoundError: No such file.
        ValueError: Not a file of measurements.
    """
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    if not lines or "machine" not in lines[0]:
        raise ValueError(f"{path}: no measurements of accuracy")
    rows, bounds = [], {}
    for line in lines[1:]:
        if "floor" in line:
            bounds[line["case"]] = {key: _number(value) for key, value in line["floor"].items()}
            continue
        for name in ("mean", "worst"):
            line[name] = {key: _number(value) for key, value in line[name].items()}
        line["axes"] = tuple(_number(value) for value in line["axes"])
        line |= {name: _number(line[name]) for name in ("wall", "cpu")}
        rows.append(Row(**line))
    head = lines[0]
    return Measured(head["machine"], head["device"], head["reference"], bounds, tuple(rows))


def _without_nan(value: Any) -> Any:
    """Replace NaN by null, which JSON can represent, and round to six digits."""
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_without_nan(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
