"""`python -m learning export-genforce`: write an archive in the GenForce training format."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from recorder.progress import ItemProgress

if TYPE_CHECKING:
    from learning.command import Subcommands


def add_to(subcommands: Subcommands) -> None:
    """Add the command and its options."""
    parser = subcommands.add_parser(
        "export-genforce",
        description="Writes img, force and depth as in the published training folders. The folder "
        "appears only when it is complete.",
    )
    parser.add_argument("archive", type=Path, metavar="ARCHIVE", help="X.markers.zarr")
    parser.add_argument("--out", type=Path, metavar="DIR", required=True, help="must not exist")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    from learning.data.genforce import export_training

    with ItemProgress("frames", sys.stderr) as progress:
        omitted = export_training(options.archive, options.out, progress=progress)
    for line in omitted:
        print(f"left out: {line}")
    print(f"{options.out}: written")
    return 0
