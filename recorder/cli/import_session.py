"""`python -m recorder import`: convert a recording made elsewhere into a session."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from recorder.cli.options import add_session
from recorder.convert import ImportRequest, import_session
from recorder.convert.import_force import FORCE_UNITS, TORQUE_UNITS
from recorder.progress import ItemProgress


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add_session(parser)
    add = parser.add_argument
    add("--video", type=Path, metavar="PATH", help="video file, or folder of images in name order")
    add("--force", type=Path, metavar="PATH", help="forces: .csv with a header, or .npy")
    add("--taxels", type=Path, metavar="PATH", help="taxel counts: .npy (n, 48) or (n, 16, 3)")
    add("--sensor", required=True, help="name of the sensor")
    add("--indenter", required=True, help="name of what touched it")
    add("--operator", default="", help="who recorded it")
    add("--fps", type=float, metavar="HZ", help="images per second (default: as the video says)")
    add("--force-hz", type=float, metavar="HZ", help="force rows per second, without a time column")
    add("--taxels-hz", type=float, metavar="HZ", help="taxel rows per second")
    forces, torques = ", ".join(FORCE_UNITS), ", ".join(TORQUE_UNITS)
    add("--units", metavar="UNIT", help=f"of forces that do not say theirs: {forces}")
    add("--torque-units", metavar="UNIT", help=f"of torques that do not say theirs: {torques}")
    add("--ignore", action="append", default=[], metavar="NAME", help="leave out this CSV column")
    add("--trim", action="store_true", help="cut all to the shortest of the recordings")


def run(options: argparse.Namespace) -> int:
    """Write the session and print what was assumed."""
    request = ImportRequest(
        out=options.session,
        sensor=options.sensor,
        indenter=options.indenter,
        video=options.video,
        force=options.force,
        taxels=options.taxels,
        fps=options.fps,
        force_hz=options.force_hz,
        taxels_hz=options.taxels_hz,
        units=options.units,
        torque_units=options.torque_units,
        ignore=tuple(options.ignore),
        trim=options.trim,
        operator=options.operator,
    )
    with ItemProgress("rows", sys.stderr) as progress:
        lines = import_session(request, progress)
    for line in lines:
        print(line)
    print(f"{options.session}: imported")
    return 0
