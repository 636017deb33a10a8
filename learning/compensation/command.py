"""`tactile compensate`: fit material priors, and choose the scaling of labels."""

import argparse
from pathlib import Path

from learning.command import named_number
from learning.errors import LearningError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Fits force over depth of each sensor (degree 2, loading and unloading) and "
        "writes, for each pair, d0 and lambda of the supplement's equations 7 to 9: a fixed "
        "default, a label-free choice by the priors' fits, and an oracle that uses the target's "
        "labels. train force --labels reads the file."
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
        help="session of `tactile force-depth`, used instead of the archive's rows",
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


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from learning.compensation.fit import Curves, write_compensation
    from recorder.archive import MarkerArchive

    archive = MarkerArchive(options.archive)
    if archive.warning:
        raise LearningError(archive.warning)
    curves = Curves(
        sessions=tuple(options.session),
        coefficients=options.coefficients,
        per_mm=options.coefficients_of == "mm",
        ranges_mm=dict(options.range_mm),
    )
    lines = write_compensation(
        archive, options.out, pairs=options.pairs, curves=curves, split=options.split
    )
    print("\n".join(lines))
    return 0


def _pairs(text: str) -> list[tuple[str, str]]:
    pairs = []
    for one in text.split(","):
        source, _, target = one.partition(":")
        if not source or not target or source == target:
            raise argparse.ArgumentTypeError(f"found {one!r}; allowed: SOURCE:TARGET, two sensors")
        pairs.append((source, target))
    return pairs
