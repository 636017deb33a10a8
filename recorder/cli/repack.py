"""`tactile session repack`: copy a session, storing its images in another encoding."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from recorder.cli.options import add_session
from recorder.convert.repack import PROFILES, repack
from recorder.progress import ItemProgress


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add_session(parser)
    parser.add_argument("destination", type=Path, help="the copy; must not exist")
    parser.add_argument(
        "--profile",
        choices=PROFILES,
        default="portable",
        help="portable: lossless pixels for every Zarr reader; camera: the camera's JPEG bytes "
        "(default: %(default)s)",
    )


def run(options: argparse.Namespace) -> int:
    """Write the copy."""
    with ItemProgress("images", sys.stderr) as progress:
        repack(options.session, options.destination, options.profile, progress=progress)
    print(f"{options.destination}: written, profile {options.profile}")
    return 0
