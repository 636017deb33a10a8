"""`python -m rig compare`: compare a mock session with the World's truth."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument("--session", type=Path, required=True, help="a session")
    parser.add_argument("--truth", type=Path, required=True, help="file from collect --truth")


def run(options: argparse.Namespace) -> int:
    """Compare and print."""
    from rig.mock.world.compare import compare

    print("\n".join(compare(options.session, options.truth)))
    return 0
