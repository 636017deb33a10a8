"""`tactile export-genforce`: write an archive in the GenForce training format."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from recorder.progress import ItemProgress


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Writes img, force and depth as in the published training folders. The folder "
        "appears only when it is complete."
    )
    parser.add_argument("archive", type=Path, metavar="ARCHIVE", help="X.markers.zarr")
    parser.add_argument("--out", type=Path, metavar="DIR", required=True, help="must not exist")


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from learning.data.genforce import export_training

    with ItemProgress("frames", sys.stderr) as progress:
        omitted = export_training(options.archive, options.out, progress=progress)
    for line in omitted:
        print(f"left out: {line}")
    print(f"{options.out}: written")
    return 0
