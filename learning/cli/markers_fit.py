"""`tactile markers-fit`: fit marker detection to pictures without contact."""

import argparse
import sys
from pathlib import Path

from learning.errors import LearningError
from recorder.command_line.options import next_command


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Finds out whether the markers in pictures without contact are dark or bright, how large "
        "and how far apart, and writes a preset for `markers --preset FILE`."
    )
    add = parser.add_argument
    add(
        "images", nargs="+", type=Path, metavar="IMAGE", help="pictures without contact, or folders"
    )
    add("--out", type=Path, metavar="YAML", help="preset to write")
    add("--pitch-mm", type=float, metavar="MM", help="distance between neighbouring markers [mm]")
    add(
        "--pressed",
        nargs="+",
        type=Path,
        default=[],
        metavar="IMAGE",
        help="pictures with contact, in which the same markers are looked for",
    )
    add("--sheet", type=Path, metavar="PNG", help="draw all pictures, with outlines")


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    import yaml

    from learning.markers.fit import (
        as_yaml,
        draw_outlines,
        files_of,
        fit_preset,
        read_picture,
        recalls,
    )
    from recorder.progress import ItemProgress

    if options.pitch_mm is not None and not 0 < options.pitch_mm < 100:
        raise LearningError(f"--pitch-mm: found {options.pitch_mm:g}; allowed: above 0 to 100")
    no_contact = [read_picture(path) for path in files_of(options.images)]
    pressed = [(path, read_picture(path)) for path in files_of(options.pressed)]
    preset, pattern = fit_preset(no_contact, pitch_mm=options.pitch_mm)
    print(pattern)
    with ItemProgress("pictures", sys.stderr) as progress:
        each_recall = recalls(preset, no_contact[0], (picture for _path, picture in pressed))
        for number, ((path, _picture), recalled) in enumerate(
            zip(pressed, each_recall, strict=True)
        ):
            progress(number, len(pressed))
            print(f"{path.name}: {recalled}")
    if options.sheet is not None:
        draw_outlines(preset, no_contact, [picture for _path, picture in pressed], options.sheet)
        print(f"{options.sheet}: written")
    text = yaml.safe_dump(as_yaml(preset), sort_keys=False, width=100)
    if options.out is None:
        print(text, end="")
        return 0
    options.out.write_text(text, encoding="utf-8")
    scale = None if preset.mm_per_px is not None else "MM"
    following = next_command(
        "markers", "SESSION", preset=options.out, mm_per_px=scale, out="X.markers.zarr"
    )
    print(f"{options.out}: written")
    print(f"next: {following}")
    return 0
