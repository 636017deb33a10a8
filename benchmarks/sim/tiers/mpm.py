"""Material-point method compared with finite elements on a sphere press.

Run with `python -m benchmarks mpm`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.sim.tiers.comparison import (
    DEPTHS,
    FORCE,
    FORCE_RELEASED,
    FORCE_STICKING,
    RADII,
    UP,
    Row,
    choices,
    measure,
    measure_elements,
)
from recorder.command_line.options import add_device
from recorder.progress import Progress
from sim.device import ready_device
from sim.errors import SimulationDiverged

ELEMENTS = "finite elements"


def table(rows: Sequence[Row]) -> list[str]:
    """Return the lines of a table: force and its error, surface around the contact, cost."""
    names = max([len(row.name) for row in rows] + [len("reference")])
    depths = ", ".join(f"{depth * 1e3:g}" for depth in DEPTHS)
    radii = ", ".join(f"{radius * 1e3:g}" for radius in RADII)
    lines = [
        f"{'':{names}}  force N (error %) at {depths} mm; up um, outward um at r = {radii} mm; "
        "particles, steps; wall s, CPU s; MB",
        f"{'reference':{names}}  {_numbers(FORCE, 7, 4)}{'':24}  {_numbers(UP, 6, 1, 1e6)}",
    ]
    for row in rows:
        errors = _errors(row, row.force)
        lines.append(
            f"{row.name:{names}}  {_numbers(row.force, 7, 4)} ({_numbers(errors, 6, 1)})  "
            f"{_numbers(row.up, 6, 1, 1e6)}  {_numbers(row.outward, 6, 1, 1e6)}  "
            f"{row.particles:7} {row.steps:6}  {row.seconds:7.1f} {row.cpu_seconds:7.1f}  "
            f"{row.bytes / 1e6:5.0f}"
        )
        if row.force_rescaled != row.force:
            lines.append(
                f"{'':{names}}  {_numbers(row.force_rescaled, 7, 4)} "
                f"({_numbers(_errors(row, row.force_rescaled), 6, 1)})  corrected for the particle "
                "volume"
            )
    lines.append(
        f"sticking contact: {FORCE_STICKING:g} N at {DEPTHS[-1] * 1e3:g} mm; released parameters: "
        f"a body of 25 x 25 x 5 mm, {', '.join(f'{force:g}' for force in FORCE_RELEASED)} N"
    )
    return lines


def _errors(row: Row, force: Sequence[float]) -> list[float]:
    return [100 * (found / exact - 1) for found, exact in zip(force, row.reference, strict=True)]


def _numbers(values: Sequence[float], width: int, digits: int, factor: float = 1.0) -> str:
    return " ".join(f"{value * factor:{width}.{digits}f}" for value in values)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.add_argument("--fine", action="store_true", help="also cells of 0.25 mm: some minutes")
    add_device(parser)
    parser.add_argument("--only", default="", help="rows whose name contains this (default: all)")
    parser.add_argument(
        "--file",
        type=Path,
        help="JSON file of measured rows; existing rows are not measured again",
    )


def run(options: argparse.Namespace) -> int:
    """Measure the rows that are not yet in the file, one after the other, and print all rows."""
    wanted = choices(fine=options.fine)
    names = [name for name in (ELEMENTS, *wanted) if options.only in name]
    known = _load(options.file)
    kernels = ready_device(options.device)
    with Progress("bench", sys.stderr, kernels=kernels) as progress:
        for done, name in enumerate(names):
            key = f"{options.device}: {name}"
            if key in known:
                continue

            def fraction(part: float, done: int = done) -> None:
                progress((done + part) / len(names))

            try:
                if name == ELEMENTS:
                    row = measure_elements(device=options.device, progress=fraction)
                else:
                    row = measure(name, *wanted[name], device=options.device, progress=fraction)
            except SimulationDiverged as diverged:
                print(f"{name}: {diverged}")
                continue
            known[key] = row
            _save(options.file, known)
    keys = [f"{options.device}: {name}" for name in names]
    print("\n".join(table([known[key] for key in keys if key in known])))
    return 0


def _load(file: Path | None) -> dict[str, Row]:
    if file is None or not file.exists():
        return {}
    rows: dict[str, dict[str, Any]] = json.loads(file.read_text())
    found = {}
    for key, row in rows.items():
        values: dict[str, Any] = {
            word: tuple(value) if isinstance(value, list) else value for word, value in row.items()
        }
        found[key] = Row(**values)
    return found


def _save(file: Path | None, rows: dict[str, Row]) -> None:
    if file is None:
        return
    partial = file.with_suffix(".partial")
    partial.write_text(json.dumps({key: asdict(row) for key, row in rows.items()}, indent=1))
    partial.replace(file)
