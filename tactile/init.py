"""`tactile init`: create the folder structure of a lab."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    Subcommands = argparse._SubParsersAction[argparse.ArgumentParser]

EXIT_WRONG_INPUT = 2
FOLDERS = ("benches/lab", "calibrations", "campaigns", "sessions")
# Number of existing entries that an error lists.
SHOWN = 5


def add_to(subcommands: Subcommands) -> None:
    """Add the command and its options."""
    parser = subcommands.add_parser(
        "init",
        help="create the folder of a lab",
        description="Creates DIR with benches/lab, calibrations, campaigns (with an example), "
        "sessions and a README. Commands run in DIR read and write their files there.",
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="new, or empty")
    parser.set_defaults(run=_run)


def run(parser: argparse.ArgumentParser, argv: Sequence[str]) -> int:
    """Run the command that `argv` names and return the exit code."""
    options = parser.parse_args(argv)
    try:
        return int(options.run(options))
    except OSError as error:
        print(f"cannot write: {error}", file=sys.stderr)
        return EXIT_WRONG_INPUT


def _run(options: argparse.Namespace) -> int:
    folder: Path = options.folder
    if folder.exists() and not folder.is_dir():
        print(f"wrong input: {folder}: a file; allowed: a new or empty folder", file=sys.stderr)
        return EXIT_WRONG_INPUT
    if folder.exists() and (there := sorted(path.name for path in folder.iterdir())):
        more = f" and {len(there) - SHOWN} more" if len(there) > SHOWN else ""
        print(
            f"wrong input: {folder}: holds {', '.join(there[:SHOWN])}{more}; allowed: a new or "
            "empty folder",
            file=sys.stderr,
        )
        return EXIT_WRONG_INPUT
    lay_out(folder)
    print(f"{folder}: created; README.md describes the folders; next:")
    print(f"  cd {folder} && tactile collect --sensor tacpalm --targets 2")
    return 0


def lay_out(folder: Path) -> None:
    """Create the folders of a lab and copy the example files into them."""
    for name in FOLDERS:
        (folder / name).mkdir(parents=True, exist_ok=True)
    day = resources.files("rig.bench") / "campaigns" / "day.yaml"
    (folder / "campaigns" / "day.yaml").write_bytes(day.read_bytes())
    readme = resources.files("tactile") / "lab.md"
    (folder / "README.md").write_bytes(readme.read_bytes())
