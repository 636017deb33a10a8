"""`python -m learning compensate`: fit material priors, and choose the scaling of labels."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from learning.command import named_number
from learning.errors import LearningError
from recorder.command_line.options import numbers
from recorder.progress import ItemProgress

if TYPE_CHECKING:
    from learning.compensation.fit import Search, StoredCompensation
    from recorder import MarkerArchive


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Fits force over depth of each sensor (degree 2, loading and unloading) and "
        "writes, for each pair, d0 and lambda of the supplement's equations 7 to 9: a fixed "
        "default, a label-free choice by the priors' fits, and an oracle that uses the target's "
        "labels. train-force --compensation reads the file."
    )
    parser.add_argument("archive", type=Path, metavar="ARCHIVE", help="X.markers.zarr")
    parser.add_argument("--out", type=Path, metavar="JSON", required=True, help="file to write")
    parser.add_argument(
        "--pairs",
        type=_pairs,
        metavar="A:B,...",
        help="labels of A for B (default: all pairs with priors)",
    )
    parser.add_argument(
        "--split",
        type=Path,
        metavar="JSON",
        help="labels of its training presses (default: all seen indenters)",
    )
    parser.add_argument(
        "--session",
        type=Path,
        action="append",
        default=[],
        metavar="SESSION",
        help="session of `python -m rig force-depth`, used instead of the archive's rows",
    )
    parser.add_argument(
        "--coefficients", type=Path, metavar="DIR", help="published <sensor>_down.csv and _up.csv"
    )
    parser.add_argument(
        "--coefficients-of",
        choices=("mm", "fraction"),
        default="mm",
        help="unit of depth in published coefficients: mm, or fraction of the depth range "
        "(heterogeneous test) (%(default)s)",
    )
    parser.add_argument(
        "--range-mm",
        type=named_number,
        action="append",
        default=[],
        metavar="SENSOR=MM",
        help="depth that counts as 1 (default: the sensor's deepest located press)",
    )
    parser.add_argument(
        "--d0",
        type=numbers(),
        metavar="FRACTION,...",
        help="starting depths to try, as fractions of the source's depth range, 0 to 1 (default: "
        "the supplement's, 0, 0.4, 0.8 mm for skins of one depth range, else 0, 0.25, 0.5, 0.75)",
    )
    parser.add_argument(
        "--lambda",
        dest="weights",
        type=numbers(),
        metavar="WEIGHT,...",
        help="weights to try, 0 to 1 (default: 0, 0.25, 0.5, 0.75, 1)",
    )
    parser.add_argument(
        "--default",
        type=numbers(2),
        metavar="D0,LAMBDA",
        help="the fixed, label-free choice (0,0.75)",
    )
    parser.add_argument(
        "--picture", type=Path, metavar="PNG", help="curves (default: next to the file)"
    )


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from learning.compensation.fit import Curves, draw_curves, find_compensation, tables
    from recorder import MarkerArchive

    archive = MarkerArchive(options.archive)
    if archive.warning:
        raise LearningError(archive.warning)
    curves = Curves(
        sessions=tuple(options.session),
        coefficients=options.coefficients,
        per_mm=options.coefficients_of == "mm",
        ranges_mm=dict(options.range_mm),
    )
    with ItemProgress("pairs", sys.stderr) as progress:
        found, gathered = find_compensation(
            archive,
            pairs=options.pairs,
            curves=curves,
            search=_search(options),
            progress=progress,
        )
    found.write(options.out)
    for line in tables(found, gathered):
        print(line)
    for line in _simulated(archive, found, options.split):
        print(line)
    picture = options.picture or options.out.with_suffix(".png")
    draw_curves(found, gathered, picture)
    print(f"{options.out}, {picture}: written")
    return 0


def _simulated(
    archive: MarkerArchive, found: StoredCompensation, split: Path | None
) -> Iterator[str]:
    """Yield R2 of the labels of each pair whose sensors both have forces of a twin."""
    from learning.compensation.simulated import simulated_r2

    for pair in found.pairs:
        r2 = simulated_r2(archive, pair.source, pair.target, split)
        if r2 is not None:
            others = {"before": pair.before, **pair.choices}
            told = "  ".join(
                f"{name} {one.r2:.2f}" for name, one in others.items() if one.r2 is not None
            )
            yield f"R2 of labels, {pair.source} > {pair.target}: {told}  simulated {r2:.2f}"


def _search(options: argparse.Namespace) -> Search:
    from learning.compensation.fit import Search

    search = Search(split=options.split)
    if options.d0 is not None:
        search = replace(search, d0=options.d0)
    if options.weights is not None:
        search = replace(search, weights=options.weights)
    if options.default is not None:
        search = replace(search, default=options.default)
    return search


def _pairs(text: str) -> list[tuple[str, str]]:
    pairs = []
    for one in text.split(","):
        source, _, target = one.partition(":")
        if not source or not target or source == target:
            raise argparse.ArgumentTypeError(f"found {one!r}; allowed: SOURCE:TARGET, two sensors")
        pairs.append((source, target))
    return pairs
