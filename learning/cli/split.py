"""`python -m learning split`: divide the presses of an archive and write the split to a file."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from recorder.command_line.options import add_seed, names_or_none

if TYPE_CHECKING:
    from learning.data.splits import Split
    from recorder import MarkerArchive


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Gives every press of an archive a role, the same for all sensors. A press "
        "is a location; all presses of unseen indenters are in the test."
    )
    parser.add_argument("archive", type=Path, metavar="ARCHIVE", help="X.markers.zarr")
    parser.add_argument("--out", type=Path, metavar="JSON", required=True, help="file to write")
    parser.add_argument(
        "--validation",
        type=float,
        default=0.1,
        metavar="SHARE",
        help="of the presses of seen indenters, for choosing settings (0.1)",
    )
    parser.add_argument(
        "--new-press",
        type=float,
        default=0.1,
        metavar="SHARE",
        help="of the presses of seen indenters, for the test (0.1)",
    )
    parser.add_argument(
        "--hold-out-sensors",
        type=names_or_none,
        default=(),
        metavar="NAME,...",
        help="sensors that no model may be trained on",
    )
    parser.add_argument(
        "--unseen",
        type=names_or_none,
        metavar="NAME,...",
        help="indenters excluded from training (the archive's list; none: '')",
    )
    add_seed(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from learning.data.splits import make_split
    from recorder import MarkerArchive

    archive = MarkerArchive(options.archive)
    split = make_split(
        archive,
        validation=options.validation,
        new_press=options.new_press,
        held_out_sensors=options.hold_out_sensors,
        seed=options.seed,
        unseen=options.unseen,
    )
    split.write(options.out)
    for line in told(split, archive):
        print(line)
    print(f"{options.out}: written, sha256 {split.fingerprint[:12]}")
    return 0


def told(split: Split, archive: MarkerArchive) -> list[str]:
    """Return lines with the number of presses and frames of each role, by sensor."""
    import numpy as np

    from learning.data.splits import ROLES

    lines = [f"{'':16s}" + "".join(f" {role:>22s}" for role in ROLES)]
    presses = [len(split.locations(role)) for role in ROLES]
    lines.append(f"{'locations':16s}" + "".join(f" {count:>22,}" for count in presses))
    for name, sensor in archive.items():
        cells = []
        for role in ROLES:
            rows = split.rows(sensor.table, role)
            pressed = len(np.unique(sensor.table["location"][rows]))
            cells.append(f" {f'{len(rows):,} of {pressed:,}':>22s}")
        held = "  held out" if name in split.held_out_sensors else ""
        lines.append(f"{name:16s}" + "".join(cells) + held)
    lines.append("a sensor's cells: frames of presses")
    return lines
