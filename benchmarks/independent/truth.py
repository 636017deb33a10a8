"""Reference solutions of axisymmetric presses, kept in `axisymmetric.csv`.

Each case is solved on two meshes, and on the discs inscribed in and around its square body.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

from benchmarks.independent.axisymmetric import Answer, AxisymmetricPress
from benchmarks.independent.cases import CASES, MM, Case
from benchmarks.independent.mesh import layer_grid

FILE = Path(__file__).with_name("axisymmetric.csv")


@dataclass(frozen=True)
class Fineness:
    """Resolution at which a case is solved."""

    elements: int
    """Number of elements along the radius of the contact."""
    growth: float
    """Growth of elements with the distance from the contact."""
    steps: int
    """Number of tip steps, with friction; half as many without."""


FINE, COARSE = Fineness(28, 0.22, 40), Fineness(14, 0.36, 20)


@dataclass(frozen=True)
class Truth:
    """Force at one depth of a case: a row of the file."""

    case: str
    kind: str
    measures: str
    """Value of `Case.measures`, separated by spaces [mm, degrees]."""
    size_mm: float
    """Width of the square body."""
    thickness_mm: float
    modulus_pa: float
    poisson: float
    friction: float
    depth_mm: float
    force_n: float
    contact_radius_mm: float
    """Largest deformed radius in contact."""
    coarse_percent: float
    """Force on the coarse mesh less that on the fine one, over the latter."""
    side_percent: float
    """Force with a disc around the square less that with a disc inside it, over the force."""
    soft_percent: float
    """Penetration of the contact over the depth; the force error is 1 to 2 times that."""
    error_percent: float
    """Uncertainty of the force: |coarse| + |side| / 2 + 2 |soft|."""


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


def truths(case: Case) -> list[Truth]:
    """Return the rows of a case.

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
        mesh = 100 * (rough.force / best.force - 1)
        soft = 100 * best.penetration
        side = 100 * (more.force - less.force) / best.force
        rows.append(
            Truth(
                case.name,
                case.kind,
                " ".join(f"{measure:g}" for measure in case.measures),
                case.size,
                case.thickness,
                case.modulus,
                case.poisson,
                case.friction,
                round(best.depth / MM, 6),
                float(f"{best.force:.6g}"),
                round(best.contact_radius / MM, 4),
                round(mesh, 4),
                round(side, 4),
                round(soft, 4),
                round(abs(mesh) + abs(side) / 2 + 2 * soft, 4),
            )
        )
    return rows


def load(path: Path = FILE) -> list[Truth]:
    """Return all rows of the file in order, or none if it does not exist."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [_row(row) for row in csv.DictReader(file)]


def make(
    only: Sequence[str] = (), path: Path = FILE, say: Callable[[str], None] = print
) -> list[str]:
    """Solve the cases missing from the file, write it after each, and return those not solved.

    Args:
        only: Words to select cases by name; empty: all cases.
        path: The file.
        say: Called with a message for each case.
    """
    from time import perf_counter

    from benchmarks.independent.axisymmetric import NotSolved

    wanted = [case for case in CASES if not only or any(word in case.name for word in only)]
    have = {row.case for row in load(path)}
    failed = []
    for index, case in enumerate(wanted, 1):
        head = f"[{index}/{len(wanted)}] {case.name}"
        if case.name in have:
            say(f"{head}: already there")
            continue
        start = perf_counter()
        try:
            rows = truths(case)
        except NotSolved as error:
            failed.append(case.name)
            say(f"{head}: not solved {error}")
            continue
        _write(path, [*load(path), *rows])
        message = ", ".join(
            f"{row.depth_mm:g} mm {row.force_n:.5g} N +- {row.error_percent:.2f} %" for row in rows
        )
        say(f"{head}: {message}; {perf_counter() - start:.0f} s")
    return failed


def _write(path: Path, rows: Sequence[Truth]) -> None:
    order = {case.name: index for index, case in enumerate(CASES)}
    kept = sorted(rows, key=lambda row: (order.get(row.case, len(order)), row.depth_mm))
    names = [one.name for one in fields(Truth)]
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        writer.writerows([getattr(row, name) for name in names] for row in kept)


def _row(stored: dict[str, str]) -> Truth:
    texts = {"case", "kind", "measures"}
    values = {
        one.name: stored[one.name] if one.name in texts else float(stored[one.name])
        for one in fields(Truth)
    }
    return Truth(**values)  # type: ignore[arg-type]
