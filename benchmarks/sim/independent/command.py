"""`sim` against solutions that others' means gave: `python -m benchmarks independent`.

With `--make`, those solutions are computed (what is missing of them) in place of the comparison.
"""

from __future__ import annotations

import argparse
import csv
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

from sim.errors import SceneError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.sim.independent.comparison import Row
    from sim.cli.options import Verbs


def add_to(verbs: Verbs) -> None:
    """The verb and its options."""
    parser = verbs.add_parser(
        "independent",
        help="forces of presses beside solutions by other means",
        description="Solves presses whose forces are known from finite elements that share no line "
        "with `sim`, and tells how far off it is. Exit 0 however far that is.",
    )
    parser.add_argument(
        "--only",
        action="append",
        default=[],
        metavar="WORD",
        help="cases whose name has this in it (may be repeated)",
    )
    parser.add_argument("--list", action="store_true", help="name the cases and end")
    parser.add_argument(
        "--set", choices=("axisymmetric", "foreign"), help="leave the other truths out"
    )
    parser.add_argument("--tolerance", metavar="ERROR", help='ask `sim` for it: "1 %%"')
    parser.add_argument("--tier", choices=("layer", "fem", "mpm"), help="the tier of `sim`")
    parser.add_argument("--processes", type=int, default=1, help="cases side by side (%(default)s)")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write the rows there too")
    parser.add_argument(
        "--make",
        choices=("axisymmetric", "foreign"),
        help="solve what the file of truths lacks, and add it",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Compare, or make truths; the exit code.

    Raises:
        SceneError: No such case; a tier and a tolerance; a number of processes below 1; truths to
            be made by GetFEM, which is not there.
        WorkerLost: A worker process was killed.
    """
    if options.make:
        return _make(options)
    from benchmarks.sim.independent.comparison import (
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
        raise SceneError(f"--only: {', '.join(options.only)!r}; allowed: part of a case's name")
    if options.list:
        print("\n".join(task.name for task in tasks))
        return 0
    rows: list[Row] = []
    print(HEAD)
    settings = Settings(options.tier, options.tolerance)
    for found in all_compared(tasks, settings, options.processes):
        print("\n".join(map(line, found)), flush=True)
        rows += found
    print(summary(rows))
    if options.csv:
        _write(options.csv, rows)
        print(f"{options.csv}: written")
    return 0


def _make(options: argparse.Namespace) -> int:
    from benchmarks.sim.independent import foreign, truth

    try:
        made = truth if options.make == "axisymmetric" else foreign
        failed = made.make(options.only)
    except foreign.MissingProgram as error:
        raise SceneError(str(error)) from error
    if failed:
        print(f"not solved: {'; '.join(failed)}")
    return int(bool(failed))


def _write(path: Path, rows: Sequence[Row]) -> None:
    from benchmarks.sim.independent.comparison import Row

    names = [one.name for one in fields(Row)]
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        writer.writerows([getattr(row, name) for name in names] for row in rows)
