"""`tactile session view`: view a session in Rerun."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from recorder.cli.options import add_session
from recorder.convert.rerun_view import view
from recorder.progress import ItemProgress


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add_session(parser)
    parser.add_argument("--save", type=Path, help="write this .rrd file and open no viewer")
    parser.add_argument(
        "--start", type=float, default=0.0, help="start this long after the first sample [s]"
    )
    parser.add_argument("--seconds", type=float, help="length to show [s] (default: to the end)")


def run(options: argparse.Namespace) -> int:
    """Open the viewer, or write its file."""
    with ItemProgress("samples", sys.stderr) as progress:
        view(
            options.session,
            save=options.save,
            start=options.start,
            seconds=options.seconds,
            progress=progress,
        )
    if options.save is not None:
        print(f"{options.save}: written")
    return 0
