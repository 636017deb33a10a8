"""`tactile import` of published GenForce folders and of the authors' trained weights.

A folder becomes a marker archive: it holds masks, not a camera's images at their times. Weights
become the folder of a trained model.
"""

import argparse
import contextlib
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from learning.command import add_unseen, named_number, named_path
from learning.errors import LearningError
from recorder.command_line.options import positive
from recorder.errors import SessionError
from recorder.progress import ItemProgress

# Folders of the published layouts.
_FOLDERS = ("img", "image", "uskin_raw")
# Names of files with the authors' weights.
WEIGHTS = (".pkl", ".pth")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of GenForce folders and weights."""
    folders = parser.add_argument_group("GenForce folders, which become a marker archive")
    weights = parser.add_argument_group("weights of the GenForce authors, which become a model")
    by_sensor = partial(folders.add_argument, action="append", default=[])
    folders.add_argument("--preset", metavar="NAME", help="marker detection in raw pictures")
    by_sensor(
        "--mm-per-px", type=named_number, metavar="SENSOR=MM", help="size of a pixel (0.0249)"
    )
    folders.add_argument(
        "--heights",
        action="store_true",
        help="depth files of uskin, tactip and gelsight hold heights (heterogeneous test)",
    )
    by_sensor(
        "--surface-mm",
        type=named_number,
        metavar="SENSOR=MM",
        help="depth files hold heights; this is the surface's",
    )
    by_sensor(
        "--plan",
        type=named_path,
        metavar="SENSOR=FILE",
        help="bench file with the trajectory by which a training folder's presses are numbered; "
        "without it their places are unknown, and they cannot be joined with other archives",
    )
    by_sensor(
        "--turn",
        type=named_number,
        metavar="SENSOR=DEG",
        help="angle from the robot's x axis to the image's, counter-clockwise, of a raw run; "
        "without it the markers of sheared presses tell the turn, or the run cannot be joined with "
        "other archives",
    )
    folders.add_argument(
        "--compensation", type=Path, metavar="DIR", help="<sensor>_down.csv and _up.csv"
    )
    add_unseen(folders)
    weights.add_argument("--base", metavar="DIR", help="SD-Turbo, for a translator: unet/, vae/")
    weights.add_argument(
        "--marker-value",
        type=positive,
        default=1.0,
        metavar="VALUE",
        help="value of a marker in the images of a force model: 1 for heterogeneous sensors, "
        "0.00392157 for homogeneous and material ones, whose images their code scales by 1/255 (1)",
    )


def layout_among(paths: Sequence[Path]) -> str | None:
    """Return the layout of a folder of the published data; None if there is none."""
    from learning.data.genforce.importing import layout_of

    layouts = []
    for path in paths:
        if path.is_dir() and _may_be_genforce(path):
            with contextlib.suppress(LearningError):
                layouts.append(layout_of(path))
    if layouts and len(paths) > 1:
        raise SessionError("found a GenForce folder among others; allowed: one at a time")
    return layouts[0] if layouts else None


def _may_be_genforce(path: Path) -> bool:
    """Return True if a folder has names of the published layouts."""
    folders = [path, *(each for each in path.iterdir() if each.is_dir())]
    named = any((each / name).is_dir() for each in folders for name in _FOLDERS)
    return named or any(path.glob("*_ref.jpg"))


def import_weights(file: Path, options: argparse.Namespace) -> int:
    """Write the folder of a model with the authors' weights, without running any code in them."""
    from learning.training.checkpoint import read_plain

    content = read_plain(file)
    if isinstance(content, dict) and "state_dict_vae" in content:
        from learning.translation.diffusion.authors import import_checkpoint

        kind, count = import_checkpoint(file, options.base or "", options.out)
    else:
        from learning.force.authors import import_force_weights

        model = import_force_weights(file, options.out, marker_value=options.marker_value)
        kind, count = "force", sum(weight.numel() for weight in model.parameters())
    print(f"{options.out}: {kind}, {count:,} numbers")
    return 0


def import_folder(folder: Path, options: argparse.Namespace) -> int:
    """Make or continue the archive of a folder and return the exit code."""
    from learning.data.genforce.format import read_compensation
    from learning.data.genforce.importing import SURFACES_MM, Choices, read_plan
    from learning.data.genforce.importing import import_folder as import_published
    from learning.markers.build import summary
    from recorder.archive import MarkerArchive

    surfaces = dict(SURFACES_MM) if options.heights else {}
    surfaces |= dict(options.surface_mm)
    choices = Choices(
        preset_name=options.preset,
        mm_per_px=dict(options.mm_per_px),
        surfaces_mm=surfaces,
        plans={name: read_plan(path) for name, path in options.plan},
        unseen=options.unseen,
        turns_deg=dict(options.turn),
        compensation=read_compensation(options.compensation) if options.compensation else {},
    )
    with ItemProgress("frames", sys.stderr) as progress:
        frames = import_published(folder, options.out, choices=choices, progress=progress)
    for line in summary(options.out):
        print(line)
    for name, sensor in MarkerArchive(options.out).items():
        if "found by the markers" in (position := str(sensor.attrs.get("position"))):
            print(f"{name}: {position}; --turn {name}=DEG decides otherwise")
        if "while force rises" in (depth := str(sensor.attrs.get("depth"))):
            print(f"{name}: {depth}; --surface-mm {name}=MM decides otherwise")
    print(f"{options.out}: {frames:,} frames read")
    return 0
