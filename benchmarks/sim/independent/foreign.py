"""Truths of presses without an axis of symmetry, by a foreign program, kept in `foreign.csv`."""

from __future__ import annotations

import csv
import json
import math
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from benchmarks.sim.independent.foreign_cases import CASES, ForeignCase

FILE = Path(__file__).with_name("foreign.csv")
ROOT = Path(__file__).parents[3]
# Environment variable with the interpreter that has GetFEM.
PYTHON = "FOREIGN_PYTHON"
# Where Debian and Ubuntu put `python3-getfem`.
SYSTEM = "/usr/bin/python3"
# What the sizes of elements are multiplied by.
FINE, COARSE = 1.3, 2.0


class MissingProgram(Exception):
    """No interpreter has GetFEM."""


@dataclass(frozen=True)
class ForeignTruth:
    """Force at one point of a path: a row of the file."""

    case: str
    shape: str
    measures: str
    """As `ForeignCase.measures` [mm]."""
    point: int
    """Which point of the path, from 0."""
    x_mm: float
    y_mm: float
    depth_mm: float
    friction: float
    force_x_n: float
    """On the body."""
    force_y_n: float
    force_z_n: float
    elements: int
    """Hexahedra of the fine mesh, of the part that is solved."""
    error_percent: float
    """Force on the coarse mesh less that on the fine one, as vectors, over the latter."""


def interpreter() -> str:
    """An interpreter that imports GetFEM.

    Raises:
        MissingProgram: There is none.
    """
    tried = [found for found in (os.environ.get(PYTHON), sys.executable, SYSTEM) if found]
    for candidate in tried:
        if not Path(candidate).exists():
            continue
        done = subprocess.run([candidate, "-c", "import getfem"], capture_output=True, check=False)
        if done.returncode == 0:
            return candidate
    raise MissingProgram(
        f"getfem: missing in {', '.join(tried)}; allowed: an interpreter that has it, in "
        f"{PYTHON} (Debian: apt-get install python3-getfem)"
    )


def load(path: Path = FILE) -> list[ForeignTruth]:
    """All rows of the file; none where there is no file."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [_row(stored) for stored in csv.DictReader(file)]


def make(
    only: Sequence[str] = (), path: Path = FILE, say: Callable[[str], None] = print
) -> list[str]:
    """Solve what the file lacks, case by case, and write it after each; what was not solved.

    Raises:
        MissingProgram: No interpreter has GetFEM.
    """
    from time import perf_counter

    python = interpreter()
    wanted = [case for case in CASES if not only or any(word in case.name for word in only)]
    failed = []
    for index, case in enumerate(wanted, 1):
        head = f"[{index}/{len(wanted)}] {case.name}"
        if any(row.case == case.name for row in load(path)):
            say(f"{head}: already there")
            continue
        start = perf_counter()
        coarse, fine = _solved(python, case, COARSE), _solved(python, case, FINE)
        if len(fine) < len(case.path) or len(coarse) < len(case.path):
            failed.append(case.name)
            say(f"{head}: not solved")
            continue
        rows = _rows(case, coarse, fine)
        _write(path, [*load(path), *rows])
        said = ", ".join(
            f"({row.force_x_n:.4g}, {row.force_y_n:.4g}, {row.force_z_n:.4g}) N "
            f"+- {row.error_percent:.2f} %"
            for row in rows
        )
        say(f"{head}: {said}; {perf_counter() - start:.0f} s")
    return failed


Force = tuple[tuple[float, float, float], int]


def _solved(python: str, case: ForeignCase, scale: float) -> list[Force]:
    """Force and number of elements at each point of the path that was reached."""
    module = "benchmarks.sim.independent.getfem_press"
    done = subprocess.run(
        [python, "-m", module, case.name, f"{scale}"],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    found = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    return [(tuple(one["force"]), one["elements"]) for one in found]


def _rows(case: ForeignCase, coarse: list[Force], fine: list[Force]) -> list[ForeignTruth]:
    rows = []
    for point, ((x, y, depth), (rough, _), (best, elements)) in enumerate(
        zip(case.path, coarse, fine, strict=True)
    ):
        rows.append(
            ForeignTruth(
                case.name,
                case.shape,
                case.text,
                point,
                x,
                y,
                depth,
                case.friction,
                float(f"{best[0]:.6g}"),
                float(f"{best[1]:.6g}"),
                float(f"{best[2]:.6g}"),
                elements,
                round(100 * math.dist(rough, best) / math.hypot(*best), 4),
            )
        )
    return rows


def _write(path: Path, rows: Sequence[ForeignTruth]) -> None:
    order = {case.name: index for index, case in enumerate(CASES)}
    kept = sorted(rows, key=lambda row: (order.get(row.case, len(order)), row.point))
    names = [one.name for one in fields(ForeignTruth)]
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        writer.writerows([getattr(row, name) for name in names] for row in kept)


def _row(stored: dict[str, str]) -> ForeignTruth:
    kinds: dict[str, Any] = {
        "case": str,
        "shape": str,
        "measures": str,
        "point": int,
        "elements": int,
    }
    names = [one.name for one in fields(ForeignTruth)]
    return ForeignTruth(**{name: kinds.get(name, float)(stored[name]) for name in names})
