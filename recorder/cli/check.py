"""`tactile session check`: check a session or a marker archive for problems."""

import argparse

from recorder.checks.check import check
from recorder.cli.options import add_session
from recorder.command_line.terminal import paint


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add_session(parser, remote=True)
    about = "hold only metadata and the ends of files against the manifest; takes seconds"
    parser.add_argument("--quick", action="store_true", help=about)


def run(options: argparse.Namespace) -> int:
    """Print the findings; return 1 if a fault or a warning is among them, 0 for notes alone."""
    findings = check(options.session, quick=options.quick)
    for finding in findings:
        print(paint(str(finding), finding.level))
    wrong = [finding for finding in findings if finding.level != "note"]
    if not wrong:
        count = len(findings)
        notes = f"no faults, {count} note{'s' * (count != 1)}" if findings else "nothing found"
        print(paint(f"{options.session}: {notes}", "good"))
    return 1 if wrong else 0
