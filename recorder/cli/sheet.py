"""`tactile session sheet`: draw a session on one page."""

from __future__ import annotations

import argparse
from pathlib import Path

from recorder.cli.options import add_session
from recorder.session.sheet import contact_sheet


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add_session(parser, remote=True)
    parser.add_argument("--output", type=Path, help="the PNG (default: SESSION with .png)")
    parser.add_argument(
        "--count", type=int, default=12, help="frames to show (default: %(default)s)"
    )


def run(options: argparse.Namespace) -> int:
    """Draw the picture."""
    place = options.session
    near = Path(place.rstrip("/").rpartition("/")[2]) if isinstance(place, str) else place
    target = options.output or near.with_suffix(".png")
    contact_sheet(options.session, target, count=options.count)
    print(f"{target}: written")
    return 0
