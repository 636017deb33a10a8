"""Command line for sessions: python -m recorder info|check|recover|repack|export|import|sheet.

`info` and `check` also accept marker archives.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from recorder.checks.check import check
from recorder.convert import FORMATS, Options, export, import_session
from recorder.convert.import_session import add_options, request_of
from recorder.convert.repack import PROFILES, repack
from recorder.convert.rerun_view import view
from recorder.errors import SessionError
from recorder.info import describe
from recorder.progress import ItemProgress
from recorder.session.recover import recover
from recorder.session.sheet import contact_sheet
from recorder.store.files import is_url

if TYPE_CHECKING:
    Subcommands = argparse._SubParsersAction[argparse.ArgumentParser]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code.

    0: done; 1: a check found problems; 2: invalid input; 130: interrupted. An interrupted command
    leaves its output either absent or unchanged.
    """
    return run(parser(), sys.argv[1:] if arguments is None else arguments)


def run(parser: argparse.ArgumentParser, argv: Sequence[str]) -> int:
    """Run the command that `argv` names; print errors and return the matching exit code."""
    options = parser.parse_args(argv)
    try:
        return int(options.run(options))
    except SessionError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"error: {error.filename or options.session}: {error.strerror}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def _info(options: argparse.Namespace) -> int:
    print(describe(options.session))
    return 0


def _check(options: argparse.Namespace) -> int:
    findings = check(options.session)
    for finding in findings:
        print(finding)
    if not findings:
        print(f"{options.session}: nothing found")
    return 1 if findings else 0


def _recover(options: argparse.Namespace) -> int:
    recovery = recover(options.session)
    for stream in recovery.streams:
        line = f"{stream.name:18s} {stream.rows:9d} rows"
        if stream.touched:
            line += f", {stream.recovered_rows} of them brought back"
            line += f", {stream.torn_bytes} torn bytes and {stream.dropped_rows} half rows dropped"
        print(line)
    what = "recovered" if recovery.touched else "nothing to do"
    print(f"{options.session}: {what}, status {recovery.status}")
    return 0


def _repack(options: argparse.Namespace) -> int:
    with ItemProgress("images", sys.stderr) as progress:
        repack(options.session, options.destination, options.profile, progress=progress)
    print(f"{options.destination}: written, profile {options.profile}")
    return 0


def _sheet(options: argparse.Namespace) -> int:
    place = options.session
    near = Path(place.rstrip("/").rpartition("/")[2]) if isinstance(place, str) else place
    target = options.output or near.with_suffix(".png")
    contact_sheet(options.session, target, count=options.count)
    print(f"{target}: written")
    return 0


def _export(options: argparse.Namespace) -> int:
    choices = Options(decode=options.decode, valid_only=options.valid_only)
    with ItemProgress("rows", sys.stderr) as progress:
        export(options.session, options.destination, options.to, options=choices, progress=progress)
    print(f"{options.destination}: written, {options.to}")
    return 0


def _import(options: argparse.Namespace) -> int:
    with ItemProgress("rows", sys.stderr) as progress:
        lines = import_session(request_of(options), progress)
    for line in lines:
        print(line)
    print(f"{options.session}: imported")
    return 0


def _place(text: str) -> str | Path:
    return text if is_url(text) else Path(text)


def _view(options: argparse.Namespace) -> int:
    with ItemProgress("samples", sys.stderr) as progress:
        view(
            options.session,
            save=options.save,
            start=options.start,
            seconds=options.seconds,
            progress=progress,
        )
    if options.save is not None:
        print(f"{options.save}: written")
    return 0


def _directory(text: str) -> Path:
    if is_url(text):
        raise argparse.ArgumentTypeError(f"{text}: remote stores are only read; copy it here first")
    return Path(text)


def parser() -> argparse.ArgumentParser:
    """Return the parser of all commands and their options."""
    made = argparse.ArgumentParser(
        prog="python -m recorder",
        description="Inspect, check and convert sessions and marker archives.",
    )
    add_to(made.add_subparsers(required=True, metavar="COMMAND"))
    return made


def add_to(commands: Subcommands) -> None:
    """Add the commands and their options."""

    def command(
        name: str, run: object, text: str, *, remote: bool = False
    ) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=text, description=text)
        where = "a directory NAME.zarr" + (" or a URL, e.g. s3://bucket/NAME.zarr" * remote)
        place = _place if remote else _directory
        added.add_argument("session", type=place, help=f"the session, {where}")
        added.set_defaults(run=run)
        return added

    command("info", _info, "Show the contents of a session or a marker archive.", remote=True)
    command(
        "check",
        _check,
        "Check a session or a marker archive for problems; exit 1 if any is found.",
        remote=True,
    )
    command("recover", _recover, "Close a session whose recording was killed.")
    pack = command("repack", _repack, "Copy a session, storing its images in another encoding.")
    pack.add_argument("destination", type=Path, help="the copy; must not exist")
    pack.add_argument(
        "--profile",
        choices=PROFILES,
        default="portable",
        help="portable: lossless pixels for every Zarr reader; camera: the camera's JPEG bytes "
        "(default: %(default)s)",
    )
    outward = command(
        "export", _export, "Write a session as LeRobot, MCAP, HDF5 or GenForce.", remote=True
    )
    outward.add_argument("destination", type=Path, help="file or folder to make; must not exist")
    known = "; ".join(f"{name}: {what}" for name, what in FORMATS.items())
    outward.add_argument("--to", choices=FORMATS, required=True, help=known)
    outward.add_argument(
        "--decode", action="store_true", help="hdf5: pixels instead of the camera's JPEG bytes"
    )
    outward.add_argument(
        "--valid-only",
        action="store_true",
        help="lerobot, genforce: leave out rows without a sample of every stream near enough "
        "(docs/reference/data-format.md: max_age [s])",
    )
    add_options(command("import", _import, "Convert a recording made elsewhere into a session."))
    viewer = command("view", _view, "View a session in Rerun.")
    viewer.add_argument("--save", type=Path, help="write this .rrd file and open no viewer")
    viewer.add_argument(
        "--start", type=float, default=0.0, help="start this long after the first sample [s]"
    )
    viewer.add_argument("--seconds", type=float, help="length to show [s] (default: to the end)")
    picture = command("sheet", _sheet, "Draw a session on one page.", remote=True)
    picture.add_argument("--output", type=Path, help="the PNG (default: SESSION with .png)")
    picture.add_argument(
        "--count", type=int, default=12, help="frames to show (default: %(default)s)"
    )


if __name__ == "__main__":
    sys.exit(main())
