"""Forces of presses at every depth in a CSV file, and their errors relative to a reference."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.sim.speed.work import TimedPress
from sim.errors import SimulationDiverged
from sim.result import Result
from sim.tolerance import left_of_difference

Array = NDArray[np.float64]
# Indenter, x, y, depth [mm].
Key = tuple[str, float, float, float]
# Force of the indenter on the body (3,) [N].
Forces = dict[Key, Array]

COLUMNS = ("indenter", "x_mm", "y_mm", "depth_mm", "fx", "fy", "fz")
# Minimum depth for the first error: at smaller depths, forces are a few hundredths of the largest.
SHALLOW_MM = 0.6


@dataclass(frozen=True, slots=True)
class Errors:
    """|F - Fref| / |Fref| over common presses and depths; NaN if there are none."""

    presses: int
    mean: float
    most: float
    """95th percentile."""
    worst: float
    worst_at: str
    normal: float
    """Mean of |Fz - Fzref| / |Fzref|."""


def forces_of(
    presses: Sequence[TimedPress], outcomes: Sequence[Result | SimulationDiverged]
) -> Forces:
    """Return the forces of the presses that have a solution."""
    found: Forces = {}
    for press, outcome in zip(presses, outcomes, strict=True):
        if isinstance(outcome, Result):
            # In the first frame the indenter only touches the surface.
            for depth, force in zip(press.depths, outcome.force[1:], strict=True):
                found[press.indenter, press.x, press.y, depth] = force
    return found


def extrapolated(fine: Forces, coarse: Forces, ratio: float) -> Forces:
    """Return the forces that both meshes have, extrapolated by the `ratio` of their spacings."""
    more = left_of_difference(ratio)
    return {
        key: force + more * (force - coarse[key]) for key, force in fine.items() if key in coarse
    }


def write_forces(path: Path, forces: Forces) -> None:
    """Write forces in [N] atomically."""
    _write(path, COLUMNS, [_line(key, force) for key, force in forces.items()])


def write_runs(path: Path, runs: dict[str, Forces]) -> None:
    """Write the forces of several runs, by name, to one file."""
    lines = [
        [name, *_line(key, force)] for name, forces in runs.items() for key, force in forces.items()
    ]
    _write(path, ("run", *COLUMNS), lines)


def read_forces(path: Path) -> Forces:
    """Read the forces written by `write_forces`; empty if there is no file.

    Raises:
        ValueError: The columns differ.
    """
    return dict(_read(line) for line in _lines(path, COLUMNS))


def read_runs(path: Path) -> dict[str, Forces]:
    """Read the forces written by `write_runs`; empty if there is no file.

    Raises:
        ValueError: The columns differ.
    """
    runs: dict[str, Forces] = {}
    for name, *line in _lines(path, ("run", *COLUMNS)):
        key, force = _read(line)
        runs.setdefault(name, {})[key] = force
    return runs


def _write(path: Path, columns: Sequence[str], lines: Sequence[Sequence[str]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    with partial.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([columns, *lines])
    partial.replace(path)


def _lines(path: Path, columns: Sequence[str]) -> list[list[str]]:
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    if not rows or rows[0] != list(columns):
        raise ValueError(f"{path}: columns {rows[:1]}; allowed: {', '.join(columns)}")
    return rows[1:]


def _line(key: Key, force: Array) -> list[str]:
    name, *place = key
    return [name, *(f"{value:g}" for value in place), *(f"{value:.7g}" for value in force)]


def _read(line: Sequence[str]) -> tuple[Key, Array]:
    name, x, y, depth, *force = line
    return (name, float(x), float(y), float(depth)), np.array([float(value) for value in force])


def errors(forces: Forces, reference: Forces, *, from_mm: float = 0.0) -> Errors:
    """Return the errors of `forces` relative to `reference`, at depths of at least `from_mm`."""
    both = [key for key in reference if key in forces and key[3] >= from_mm - 1e-9]
    if not both:
        nothing = float("nan")
        return Errors(0, nothing, nothing, nothing, "", nothing)
    true = np.array([reference[key] for key in both])
    off = np.array([forces[key] for key in both]) - true
    fraction = np.linalg.norm(off, axis=1) / np.linalg.norm(true, axis=1)
    worst = int(fraction.argmax())
    name, x, y, depth = both[worst]
    return Errors(
        presses=len({key[:3] for key in both}),
        mean=float(fraction.mean()),
        most=float(np.percentile(fraction, 95)),
        worst=float(fraction[worst]),
        worst_at=f"{name} at ({x:g}, {y:g}) mm, {depth:g} mm deep",
        normal=float(np.mean(np.abs(off[:, 2]) / np.abs(true[:, 2]))),
    )
