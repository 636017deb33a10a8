"""`tactile translate`: translate frames of sensors into frames of other sensors."""

from __future__ import annotations

import argparse
import sys
from itertools import permutations
from pathlib import Path
from typing import TYPE_CHECKING

from learning.errors import LearningError
from recorder.command_line.options import add_device, names
from recorder.progress import ItemProgress

if TYPE_CHECKING:
    from learning.translation.archive import Pair
    from recorder.archive import MarkerArchive


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Writes a marker archive with a sensor A-to-B for each pair: translated frames "
        "and labels of A, references and scale of B. Repeat the command with the same options to "
        "continue."
    )
    add = parser.add_argument
    add("archive", type=Path, metavar="ARCHIVE", help="X.markers.zarr")
    add("--source", type=names, metavar="A,...", help="sensors whose frames are translated")
    add("--target", type=names, metavar="B,...", help="sensors that they are translated to")
    add("--all", action="store_true", help="every sensor to every other")
    add(
        "--model",
        default="flow",
        metavar="NAME|FOLDER",
        help="flow, which needs no training, one of an installed package, or the folder of a "
        "training run (%(default)s)",
    )
    add("--out", type=Path, required=True, metavar="PATH", help="Y.markers.zarr")
    add("--split", type=Path, metavar="JSON", help="a split, for --role")
    add(
        "--role",
        type=names,
        metavar="NAME,...",
        help="only these parts of the split, e.g. new_press",
    )
    add_device(parser)
    add("--sheet", type=Path, metavar="PNG", help="draw a contact sheet as well")


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    if (options.split is None) != (options.role is None):
        raise LearningError("--split, --role: found one; allowed: both or neither")

    from learning.data.splits import read_split
    from learning.translation.archive import NamedTranslator, draw_sheet, translate_archive
    from learning.translation.loading import hash_of, load_translator
    from recorder.archive import MarkerArchive

    archive = MarkerArchive(options.archive)
    pairs = _pairs(archive, options)
    translator = load_translator(options.model, options.device)
    model = NamedTranslator(
        translator, Path(options.model).name, hash_of(options.model), options.device
    )
    with ItemProgress("frames", sys.stderr) as progress:
        count = translate_archive(
            archive,
            options.out,
            pairs,
            model,
            split=None if options.split is None else read_split(options.split),
            roles=options.role or [],
            progress=progress,
        )
    if options.sheet is not None:
        draw_sheet(archive, MarkerArchive(options.out), options.sheet)
        print(f"{options.sheet}: written")
    print(f"{options.out}: {len(pairs)} pairs, {count:,} frames made")
    return 0


def _pairs(archive: MarkerArchive, options: argparse.Namespace) -> list[Pair]:
    from learning.translation.archive import Pair

    ends = options.source, options.target
    if options.all:
        if ends != (None, None):
            raise LearningError("--all: found with --source or --target; allowed: one of them")
        return [Pair(*names) for names in permutations(archive, 2)]
    if None in ends:
        raise LearningError("--source, --target: missing; allowed: both, or --all")
    pairs = [Pair(one, other) for one in options.source for other in options.target if one != other]
    if not pairs:
        raise LearningError(
            f"--target: found {','.join(options.target)}, the source itself; allowed: others"
        )
    return pairs
