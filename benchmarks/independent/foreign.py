"""Reference solutions of presses without axial symmetry, by GetFEM, kept in `foreign.csv`."""

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

from benchmarks.independent.foreign_cases import CASES, ForeignCase

FILE = Path(__file__).with_name("foreign.csv")
ROOT = Path(__file__).parents[2]
# Environment variable with the interpreter that has GetFEM.
PYTHON = "FOREIGN_PYTHON"
# Interpreter for which Debian and Ubuntu install `python3-getfem`.
SYSTEM = "/usr/bin/python3"
# Factors on the element sizes.
FINE, COARSE = 1.3, 2.0


class MissingProgram(Exception):
    """Raised if no interpreter has GetFEM."""


@dataclass(frozen=True)
class ForeignTruth:
    """Force at one point of a path: a row of the file."""

    case: str
    shape: str
    measures: str
    """Value of `ForeignCase.measures` [mm]."""
    point: int
    """Index of the point of the path, from 0."""
    x_mm: float
    y_mm: float
    depth_mm: float
    friction: float
    force_x_n: float
    """Force on the body."""
    force_y_n: float
    force_z_n: float
    elements: int
    """Number of hexahedra of the fine mesh, in the part that is solved."""
    error_percent: float
    """Difference between the forces on the coarse and fine mesh, as vectors, over the latter."""


def interpreter() -> str:
    """Return an interpreter that can import GetFEM.

    Raises:
        MissingProgram: No interpreter has it.
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
    """Return all rows of the file, or none if it does not exist."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [_row(stored) for stored in csv.DictReader(file)]


def make(
    only: Sequence[str] = (), path: Path = FILE, say: Callable[[str], None] = print
) -> list[str]:
    """Solve the cases missing from the file, write it after each, and return those not solved.

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
        message = ", ".join(
            f"({row.force_x_n:.4g}, {row.force_y_n:.4g}, {row.force_z_n:.4g}) N "
            f"+- {row.error_percent:.2f} %"
            for row in rows
        )
        say(f"{head}: {message}; {perf_counter() - start:.0f} s")
    return failed


Force = tuple[tuple[float, float, float], int]


def _solved(python: str, case: ForeignCase, scale: float) -> list[Force]:
    """Return the force and number of elements at each point of the path that was reached."""
    module = "benchmarks.independent.getfem_press"
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
