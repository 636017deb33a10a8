"""`python -m recorder check`: check a session or a marker archive for problems."""

from __future__ import annotations

import argparse

from recorder.checks.check import check
from recorder.cli.options import add_session


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add_session(parser, remote=True)


def run(options: argparse.Namespace) -> int:
    """Print the findings; return 1 if there are any."""
    findings = check(options.session)
    for finding in findings:
        print(finding)
    if not findings:
        print(f"{options.session}: nothing found")
    return 1 if findings else 0
