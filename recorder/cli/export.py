"""`tactile session export`: write a session or marker archive for other programs."""

import argparse
import sys
from pathlib import Path

from recorder.cli.options import add_session
from recorder.convert import FORMATS, Options, export
from recorder.progress import ItemProgress


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add_session(parser, remote=True)
    parser.add_argument("destination", type=Path, help="file or folder to make; must not exist")
    formats = "; ".join(f"{name}: {row.content}" for name, row in FORMATS.items())
    parser.add_argument("--to", choices=FORMATS, required=True, help=formats)
    parser.add_argument(
        "--images",
        choices=("stored", "pixels"),
        default="stored",
        help="zarr, hdf5: images as stored, such as the camera's JPEG bytes, or lossless pixels, "
        "which every reader understands (default: %(default)s)",
    )
    parser.add_argument(
        "--valid-only",
        action="store_true",
        help="lerobot, genforce: leave out rows without a sample of every stream near enough "
        "(docs/reference/data-format.md: max_age [s])",
    )


def run(options: argparse.Namespace) -> int:
    """Write the file or folder."""
    choices = Options(images=options.images, valid_only=options.valid_only)
    with ItemProgress("rows", sys.stderr) as progress:
        omitted = export(
            options.session, options.destination, options.to, options=choices, progress=progress
        )
    for line in omitted:
        print(f"left out: {line}")
    print(f"{options.destination}: written, {options.to}")
    return 0
