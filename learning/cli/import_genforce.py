"""`tactile import-genforce`: convert published GenForce folders to a marker archive."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from learning.command import add_unseen, named_number, named_path
from learning.errors import LearningError
from recorder.progress import ItemProgress


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Reads a folder of the published recordings: one with img, force and depth, "
        "one of simulated pictures, or a raw collection run. Repeat the command to continue."
    )
    parser.add_argument("folder", type=Path, metavar="DIR")
    parser.add_argument("--out", type=Path, metavar="PATH", required=True, help="X.markers.zarr")
    add_options(parser)


def add_options(parser: argparse._ActionsContainer) -> None:
    """Add the options of GenForce folders; `tactile import` has them too."""
    parser.add_argument("--preset", metavar="NAME", help="marker detection in raw pictures")
    parser.add_argument(
        "--mm-per-px",
        type=named_number,
        action="append",
        default=[],
        metavar="SENSOR=MM",
        help="size of a pixel (0.0249)",
    )
    parser.add_argument(
        "--heights",
        action="store_true",
        help="depth files of uskin, tactip and gelsight hold heights (heterogeneous test)",
    )
    parser.add_argument(
        "--surface-mm",
        type=named_number,
        action="append",
        default=[],
        metavar="SENSOR=MM",
        help="depth files hold heights; this is the surface's",
    )
    parser.add_argument(
        "--plan",
        type=named_path,
        action="append",
        default=[],
        metavar="SENSOR=FILE",
        help="bench file with the trajectory by which a training folder's presses are numbered; "
        "without it their places are unknown, and they cannot be joined with other archives",
    )
    parser.add_argument(
        "--turn",
        type=named_number,
        action="append",
        default=[],
        metavar="SENSOR=DEG",
        help="angle from the robot's x axis to the image's, counter-clockwise, of a raw run; "
        "without it the markers of sheared presses tell the turn, or the run cannot be joined with "
        "other archives",
    )
    parser.add_argument(
        "--compensation", type=Path, metavar="DIR", help="<sensor>_down.csv and _up.csv"
    )
    add_unseen(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    return import_one(options.folder, options)


def known_layout(folder: Path) -> str | None:
    """Return the layout of a folder of the published data; None if it is none."""
    from learning.data.genforce.importing import layout_of

    try:
        return layout_of(folder)
    except LearningError:
        return None


def import_one(folder: Path, options: argparse.Namespace) -> int:
    """Make or continue the archive of a folder and return the exit code."""
    from learning.data.genforce import import_folder, read_compensation, read_plan
    from learning.data.genforce.importing import Choices
    from learning.data.genforce.training import SURFACES_MM
    from learning.markers.build import told
    from recorder import MarkerArchive

    surfaces = dict(SURFACES_MM) if options.heights else {}
    surfaces |= dict(options.surface_mm)
    choices = Choices(
        preset_name=options.preset,
        mm_per_px=dict(options.mm_per_px),
        surfaces_mm=surfaces,
        plans={name: read_plan(path) for name, path in options.plan},
        unseen=options.unseen,
        turns_deg=dict(options.turn),
        compensation={}
        if options.compensation is None
        else read_compensation(options.compensation),
    )
    with ItemProgress("frames", sys.stderr) as progress:
        made = import_folder(folder, options.out, choices=choices, progress=progress)
    for line in told(options.out):
        print(line)
    for name, sensor in MarkerArchive(options.out).items():
        if "found by the markers" in (position := str(sensor.attrs.get("position"))):
            print(f"{name}: {position}; --turn {name}=DEG decides otherwise")
    print(f"{options.out}: {made:,} frames read")
    return 0
