"""Forces of presses by other methods: stored beside this file, and solved again.

`axisymmetric.csv` is by the solver of this folder: each case on two meshes, and on the discs
inscribed in and around its square body. `foreign.csv` is by GetFEM on two meshes, in an interpreter
that has it.
"""

from __future__ import annotations

import csv
import functools
import json
import math
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

from benchmarks.independent.axisymmetric import Answer, AxisymmetricPress
from benchmarks.independent.cases import CASES, MM, Case
from benchmarks.independent.foreign_cases import CASES as FOREIGN
from benchmarks.independent.foreign_cases import ForeignCase
from benchmarks.independent.mesh import layer_grid

AXISYMMETRIC, GETFEM = (
    Path(__file__).with_name(f"{name}.csv") for name in ("axisymmetric", "foreign")
)
ROOT = Path(__file__).parents[2]
# Environment variable with the interpreter that has GetFEM, and the one for which Debian and Ubuntu
# install `python3-getfem`.
PYTHON, SYSTEM = "FOREIGN_PYTHON", "/usr/bin/python3"
# Factors on the element sizes of GetFEM's meshes.
GETFEM_FINE, GETFEM_COARSE = 1.3, 2.0


@dataclass(frozen=True)
class Fineness:
    """Resolution at which an axisymmetric case is solved."""

    elements: int
    """Number of elements along the radius of the contact."""
    growth: float
    """Growth of elements with the distance from the contact."""
    steps: int
    """Number of tip steps, with friction; half as many without."""


FINE, COARSE = Fineness(28, 0.22, 40), Fineness(14, 0.36, 20)


@dataclass(frozen=True)
class Truth:
    """Force on the body at one tip of a case: a row of a file."""

    case: str
    x_mm: float
    y_mm: float
    depth_mm: float
    force_x_n: float
    """NaN of axisymmetric cases, as that along y."""
    force_y_n: float
    force_z_n: float
    error_percent: float
    """Uncertainty of the force."""

    @property
    def force(self) -> tuple[float, float, float]:
        """Force on the body [N]."""
        return self.force_x_n, self.force_y_n, self.force_z_n


def load(path: Path) -> list[Truth]:
    """Return all rows of a file."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return [
        Truth(row.pop("case"), **{name: float(text) for name, text in row.items()}) for row in rows
    ]


def add(path: Path, rows: Sequence[Truth]) -> None:
    """Write new rows into a file, in the order of the cases."""
    cases: list[Case | ForeignCase] = [*CASES, *FOREIGN]
    order = {case.name: index for index, case in enumerate(cases)}
    both = [*load(path), *rows]
    names = [each.name for each in fields(Truth)]
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        for row in sorted(both, key=lambda row: order[row.case]):
            writer.writerow([getattr(row, name) for name in names])


def solved(case: Case, radius: float, fineness: Fineness) -> list[Answer]:
    """Solve the press of a case into a disc of `radius` [m].

    Raises:
        NotSolved: Newton's method did not converge.
    """
    layer = case.layer(radius)
    grid = layer_grid(
        radius, layer.thickness, case.places(fineness.elements), growth=fineness.growth
    )
    low, high = case.touched(max(case.depths))
    wide = (high - low) / (1 if low == 0 else 2) * MM
    press = AxisymmetricPress(layer, case.profile, grid, case.friction, wide)
    steps = fineness.steps if case.friction else fineness.steps // 2
    return press.run([depth * MM for depth in case.depths], case.path(steps))


def by_axisymmetric(case: Case) -> list[Truth]:
    """Return the rows of a case.

    The error is the sum of the difference from a mesh with half as many elements along the contact
    (and, with friction, half as many steps); half the difference between a disc around the square
    body and one inside it (the reference is the disc of equal area); and twice the penetration that
    is left of the contact, over the depth.

    Raises:
        NotSolved: Newton's method did not converge.
    """
    half = case.size / 2 * MM
    equal = 2 * half / math.sqrt(math.pi)
    fine, coarse = solved(case, equal, FINE), solved(case, equal, COARSE)
    # Friction hardly changes the effect of the side, and needs many steps.
    slippery = replace(case, friction=0.0)
    inside, around = (solved(slippery, half * size, COARSE) for size in (1.0, math.sqrt(2)))
    rows = []
    for best, rough, less, more in zip(fine, coarse, inside, around, strict=True):
        side = abs(more.force - less.force) / best.force / 2
        error = abs(rough.force / best.force - 1) + side + 2 * best.penetration
        force = float(f"{-best.force:.6g}")
        depth = round(best.depth / MM, 6)
        rows.append(
            Truth(case.name, 0.0, 0.0, depth, math.nan, math.nan, force, round(100 * error, 4))
        )
    return rows


@functools.cache
def interpreter() -> str | None:
    """Return an interpreter that can import GetFEM, or None."""
    for candidate in (os.environ.get(PYTHON), sys.executable, SYSTEM):
        if candidate and Path(candidate).exists():
            tried = [candidate, "-c", "import getfem"]
            if subprocess.run(tried, capture_output=True, check=False).returncode == 0:
                return candidate
    return None


def by_getfem(case: ForeignCase) -> list[Truth]:
    """Return the rows of a case; the error is the difference from a coarser mesh, as vectors.

    Points of the path that were not reached on either mesh have no row.
    """
    rows = []
    coarse, fine = (_points(case, scale) for scale in (GETFEM_COARSE, GETFEM_FINE))
    for (x, y, depth), rough, best in zip(case.path, coarse, fine, strict=False):
        error = round(100 * math.dist(rough, best) / math.hypot(*best), 4)
        along, across, up = (float(f"{each:.6g}") for each in best)
        rows.append(Truth(case.name, x, y, depth, along, across, up, error))
    return rows


def _points(case: ForeignCase, scale: float) -> list[list[float]]:
    """Return the force at each point of the path that GetFEM reached."""
    done = subprocess.run(
        [interpreter() or "", "-m", "benchmarks.independent.getfem_press", case.name, f"{scale}"],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    return [line["force"] for line in lines]
