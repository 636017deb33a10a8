"""The table of errors and work: one row a scene and choice, in a file that people can read."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sim.planner.choices import Choice
from sim.planner.features import NAMES, Features
from sim.planner.tolerance import KINDS, Kind

TRAINING = Path(__file__).parent / "cost_table.csv"
"""What the plans are made from."""
HELD_OUT = Path(__file__).parent / "held_out.csv"
"""Scenes that the plans were not made from, to check them."""

_WORK = ("elements", "newton", "cg")
_COLUMNS = (
    "scene", "shape", *NAMES, "tier", "cells", "precision", *_WORK, *KINDS,
    *(f"bar_{kind}" for kind in KINDS),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class CostRow:
    """One scene solved one way."""

    scene: str
    """Its name; rows of one scene share it."""
    shape: str
    features: Features
    choice: Choice
    work: dict[str, float]
    """Elements, Newton and conjugate-gradient iterations of the press; 0 where unsolved."""
    error: dict[Kind, float]
    """Against the reference: of the largest frame and axis; `force` over the probe's largest force,
    `marker` over the markers' motion. inf where it was not solved."""
    bar: dict[Kind, float]
    """Difference from the companion mesh, in the same measures; of float64 from float32 on the same
    mesh. NaN where there is none."""


@dataclass(frozen=True, slots=True)
class Table:
    """Rows, and under what conditions they were measured."""

    conditions: dict[str, str]
    rows: tuple[CostRow, ...]


def write(path: Path, table: Table) -> None:
    """Write a table; numbers to four digits, so that a change of the solver shows line by line."""
    lines = [f"# {name}: {value}" for name, value in table.conditions.items()]
    lines.append(",".join(_COLUMNS))
    for row in table.rows:
        cells = [row.scene, row.shape]
        cells += [_short(value) for value in row.features.values()]
        cells += [row.choice.tier, str(row.choice.cells), row.choice.precision]
        cells += [f"{row.work[name]:.0f}" for name in _WORK]
        cells += [_short(row.error[kind]) for kind in KINDS]
        cells += [_short(row.bar[kind]) for kind in KINDS]
        lines.append(",".join(cells))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read(path: Path) -> Table:
    """The table that `write` wrote.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It has other columns.
    """
    lines = path.read_text(encoding="utf-8").splitlines()
    head = [line[2:].partition(": ") for line in lines if line.startswith("# ")]
    conditions = {name: value for name, _colon, value in head}
    reader = csv.DictReader(line for line in lines if not line.startswith("#"))
    if tuple(reader.fieldnames or ()) != _COLUMNS:
        raise ValueError(f"{path}: columns {reader.fieldnames}; allowed: {_COLUMNS}")
    return Table(conditions, tuple(_row(line) for line in reader))


def merged(tables: Sequence[Table]) -> Table:
    """All rows of tables measured under the same conditions.

    Raises:
        ValueError: The conditions differ.
    """
    for table in tables[1:]:
        if table.conditions != tables[0].conditions:
            raise ValueError(f"conditions: {table.conditions} and {tables[0].conditions}")
    return Table(tables[0].conditions, tuple(row for table in tables for row in table.rows))


def _row(line: dict[str, str]) -> CostRow:
    choice = Choice(line["tier"], int(line["cells"]), line["precision"])  # type: ignore[arg-type]
    return CostRow(
        scene=line["scene"],
        shape=line["shape"],
        features=Features(**{name: float(line[name]) for name in NAMES}),
        choice=choice,
        work={name: float(line[name]) for name in _WORK},
        error={kind: float(line[kind]) for kind in KINDS},
        bar={kind: float(line[f"bar_{kind}"]) for kind in KINDS},
    )


def _short(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else str(value)
