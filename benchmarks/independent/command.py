"""`sim` compared with independent solutions: `python -m benchmarks independent`.

With `--make`, missing solutions are computed instead of the comparison.
"""

from __future__ import annotations

import argparse
import csv
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

from recorder.command_line.options import add_device
from sim.errors import SceneError
from sim.fem import Fem
from sim.layer import Layer
from sim.mpm import Mpm

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.independent.comparison import Row


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Solves presses whose forces are known from finite elements that share no code "
        "with `sim`, and reports the error of `sim`. The exit code is 0 for any error."
    )
    parser.add_argument(
        "--only",
        action="append",
        default=[],
        metavar="WORD",
        help="cases whose name contains this (may be repeated)",
    )
    parser.add_argument("--list", action="store_true", help="list the cases and exit")
    parser.add_argument(
        "--set", choices=("axisymmetric", "foreign"), help="compare with this set only"
    )
    parser.add_argument("--tolerance", metavar="ERROR", help='tolerance for `sim`: "1 %%"')
    parser.add_argument("--tier", choices=("layer", "fem", "mpm"), help="the tier of `sim`")
    parser.add_argument(
        "--processes", type=int, default=1, help="number of parallel cases (%(default)s)"
    )
    add_device(parser)
    parser.add_argument("--csv", type=Path, metavar="FILE", help="also write the rows to this file")
    parser.add_argument(
        "--make",
        choices=("axisymmetric", "foreign"),
        help="solve the cases missing from the reference file, and add them",
    )


def run(options: argparse.Namespace) -> int:
    """Compare, or make reference solutions, and return the exit code.

    Raises:
        SceneError: Unknown case; both a tier and a tolerance; fewer than 1 process; GetFEM is
            needed but not installed.
        WorkerLost: A worker process was killed.
    """
    if options.make:
        return _make(options)
    from benchmarks.independent.comparison import (
        HEAD,
        Settings,
        all_compared,
        foreign_tasks,
        line,
        round_tasks,
        summary,
    )

    if options.tier and options.tolerance:
        raise SceneError(f"--tier: {options.tier!r} with --tolerance; allowed: either")
    if options.processes < 1:
        raise SceneError(f"--processes: {options.processes}; allowed: 1 or more")
    tasks = [] if options.set == "foreign" else round_tasks(options.only)
    if options.set != "axisymmetric":
        tasks += foreign_tasks(options.only)
    if not tasks:
        raise SceneError(
            f"--only: {', '.join(options.only)!r}; allowed: part of the name of a case"
        )
    if options.list:
        print("\n".join(task.name for task in tasks))
        return 0
    rows: list[Row] = []
    print(HEAD)
    tier = {"layer": Layer, "fem": Fem, "mpm": Mpm}[options.tier or "fem"]()
    settings = Settings(tier, options.tolerance, options.device)
    for found in all_compared(tasks, settings, options.processes):
        print("\n".join(map(line, found)), flush=True)
        rows += found
    print(summary(rows))
    if options.csv:
        _write(options.csv, rows)
        print(f"{options.csv}: written")
    return 0


def _make(options: argparse.Namespace) -> int:
    from benchmarks.independent import foreign, truth

    try:
        made = truth if options.make == "axisymmetric" else foreign
        failed = made.make(options.only)
    except foreign.MissingProgram as error:
        raise SceneError(str(error)) from error
    if failed:
        print(f"not solved: {'; '.join(failed)}")
    return int(bool(failed))


def _write(path: Path, rows: Sequence[Row]) -> None:
    from benchmarks.independent.comparison import Row

    names = [one.name for one in fields(Row)]
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        writer.writerows([getattr(row, name) for name in names] for row in rows)
