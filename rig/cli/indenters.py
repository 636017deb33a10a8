"""`python -m rig indenters`: list the indenters with size and tip, and write their drawings."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from recorder.command_line.errors import EXIT_DONE


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Lists the indenters that a session may have: the 18 of the paper, and those of "
        "the folder indenters/, NAME.yaml (tip, size_mm, optionally stl and drawing) or NAME.stl."
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="indenters (default: all)")
    parser.add_argument("--drawings", type=Path, metavar="DIR", help="copy the drawings to DIR")


def run(options: argparse.Namespace) -> int:
    """List the indenters; return the exit code.

    Raises:
        ConfigError: A name is unknown, or a file is wrong.
    """
    from rig.bench.indenter import find_indenter, indenter_names

    for name in options.names or indenter_names():
        indenter = find_indenter(name, "NAME")
        print(indenter.line())
        if options.drawings is not None and indenter.drawing is not None:
            options.drawings.mkdir(parents=True, exist_ok=True)
            print(shutil.copy(indenter.drawing, options.drawings / f"{name}.png"))
    return EXIT_DONE
