"""`tactile session info`: show the contents of a session or a marker archive."""

from __future__ import annotations

import argparse

from recorder.cli.options import add_session
from recorder.info import describe


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add_session(parser, remote=True)


def run(options: argparse.Namespace) -> int:
    """Print the description."""
    print(describe(options.session))
    return 0
