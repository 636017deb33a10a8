"""`tactile init`: create the folder structure of a lab."""

import argparse
import shlex
from importlib import resources
from pathlib import Path

from recorder.command_line.errors import CommandError
from recorder.command_line.options import next_command

FOLDERS = ("benches/lab", "calibrations", "campaigns", "indenters", "sessions")
# Number of existing entries that an error lists.
LISTED_MAX = 5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Creates DIR with benches/lab, calibrations, campaigns (with an example), "
        "indenters, sessions and a README. Commands run in DIR read and write their files there."
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="new, or empty")


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    folder: Path = options.folder
    if folder.exists() and not folder.is_dir():
        raise CommandError(f"{folder}: a file; allowed: a new or empty folder")
    if folder.exists() and (there := sorted(path.name for path in folder.iterdir())):
        more = f" and {len(there) - LISTED_MAX} more" if len(there) > LISTED_MAX else ""
        listed = ", ".join(there[:LISTED_MAX])
        raise CommandError(f"{folder}: holds {listed}{more}; allowed: a new or empty folder")
    lay_out(folder)
    print(f"{folder}: created; README.md describes the folders; next:")
    enter = f"cd {shlex.quote(str(folder))} && " if folder.resolve() != Path.cwd() else ""
    print(f"  {enter}{next_command('doctor', sensor='tacpalm')}")
    return 0


def lay_out(folder: Path) -> None:
    """Create the folders of a lab and the example files in them."""
    for name in FOLDERS:
        (folder / name).mkdir(parents=True, exist_ok=True)
    day = resources.files("rig.bench") / "campaigns" / "day.yaml"
    (folder / "campaigns" / "day.yaml").write_bytes(day.read_bytes())
    readme = resources.files("tactile") / "lab.md"
    (folder / "README.md").write_bytes(readme.read_bytes())
