"""`tactile session seal`: make the manifest of a closed session again after it was lost."""

from __future__ import annotations

import argparse

from recorder.checks.reseal import reseal
from recorder.cli.options import add_session


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Checks every chunk, length and remaining manifest of a closed session, then makes its "
        "lost manifest again. The session says from then on that it was sealed later: changes "
        "before that moment cannot be seen."
    )
    add_session(parser)


def run(options: argparse.Namespace) -> int:
    """Seal the session and print what was lost."""
    lost = reseal(options.session)
    runs = ", ".join(map(str, lost))
    done = f"sealed again; the manifest of run {runs} was lost" if lost else "nothing to do"
    print(f"{options.session}: {done}")
    return 0
