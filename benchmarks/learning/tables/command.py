"""The paper's tables from experiments with groups of sensors.

`python -m benchmarks learning-tables`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from learning.errors import LearningError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Collects experiments, complete or not, on one page: goals, means over pairs, "
        "all pairs, the paper's numbers next to ours; forces in N and relative to the labels' "
        "standard deviation. CSV files and plots go to a folder named after the page."
    )
    parser.add_argument(
        "experiments",
        nargs="+",
        metavar="[NAME=]EXPERIMENT",
        help="folders of `experiment`; NAME replaces the folder's name",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="PAGE.md", help="the page")
    parser.add_argument("--intro", type=Path, metavar="FILE", help="Markdown text above the tables")


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from benchmarks.learning.tables.group_results import read_group
    from benchmarks.learning.tables.page import write_tables

    if options.out.suffix != ".md":
        raise LearningError(f"--out: found {options.out}; allowed: a name that ends in .md")
    intro = ""
    if options.intro is not None:
        if not options.intro.is_file():
            raise LearningError(f"--intro: found no {options.intro}; allowed: a file of text")
        intro = options.intro.read_text(encoding="utf-8")
    groups = []
    for message in options.experiments:
        name, found, folder = message.partition("=")
        path = Path(folder if found else message)
        groups.append(read_group(name if found else path.name, path))
    if len({group.name for group in groups}) < len(groups):
        raise LearningError(f"experiments: found {options.experiments}; allowed: different names")
    for path in write_tables(groups, options.out, intro):
        print(path)
    return 0
