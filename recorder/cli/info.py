"""`tactile session info`: show the contents of a session or a marker archive."""

import argparse
from pathlib import Path

from recorder.cli.options import add_session
from recorder.info import describe
from recorder.session.sheet import contact_sheet


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add_session(parser, remote=True)
    about = "also draw a session on one page: frames, force and depth over time"
    parser.add_argument("--picture", type=Path, metavar="PNG", help=about)


def run(options: argparse.Namespace) -> int:
    """Print the description and draw the picture."""
    print(describe(options.session))
    if options.picture is not None:
        contact_sheet(options.session, options.picture)
        print(f"{options.picture}: written")
    return 0
