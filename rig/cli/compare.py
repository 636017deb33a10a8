"""`python -m rig compare`: compare a mock session with the World's truth."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rig.cli.options import Subcommands


def add_to(subcommands: Subcommands) -> None:
    """Add the verb and its options."""
    parser = subcommands.add_parser(
        "compare", help="compare a mock session with the World's ground truth"
    )
    parser.add_argument("--session", type=Path, required=True, help="a session")
    parser.add_argument("--truth", type=Path, required=True, help="file from collect --truth")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Compare and print."""
    from rig.mock.world.compare import compare

    print("\n".join(compare(options.session, options.truth)))
    return 0
