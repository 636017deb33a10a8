"""`tactile doctor`: test a bench's devices, its plan, and the computer; nothing moves."""

from __future__ import annotations

import argparse
import getpass
import logging
import os
import shlex
import sys
import tempfile
from pathlib import Path

from recorder.command_line.errors import EXIT_DEVICE_LOST, EXIT_DONE
from rig.acquire.calibration import store
from rig.acquire.doctor import Finding, examine, missing_rights
from rig.bench.bench import Bench
from rig.cli.options import (
    bench_command,
    bench_options,
    calibration_options,
    chosen_bench,
)
from rig.cli.recording import started_bench
from rig.cli.terminal import confirm
from rig.core.clock import SystemClock
from rig.core.errors import ConfigError

# Default folder of sessions.
SESSIONS = Path("sessions")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    bench_options(parser)
    parser.description = (
        "Tests all devices of a bench at once, and the computer: answers, rates, values at rest, "
        "disk, real-time rights, clock. Draws the plan, checks its limits. Each fault comes with "
        "its cure. Nothing moves; leave the sensor without contact. A mock bench starts its "
        "emulators. Exit code 0 if there is no fault, 2 wrong input, 3 a fault."
    )
    parser.epilog = "Example: tactile doctor --sensor tacpalm"
    parser.add_argument(
        "--out",
        type=Path,
        default=SESSIONS,
        metavar="DIR",
        help="folder of sessions, whose disk is tested, and of the plan's picture (%(default)s)",
    )
    calibration_options(parser)
    parser.add_argument(
        "--fix",
        action="store_true",
        help="write what gives you real-time priority and access to pedal and SpaceMouse, after "
        "asking (needs root); tests nothing",
    )


def run(options: argparse.Namespace) -> int:
    """Print a line for each part, and its cures; return the exit code."""
    file = chosen_bench(options)
    bench = file.bench
    if options.fix:
        return fix(bench, os.environ.get("SUDO_USER") or getpass.getuser(), Path("/etc"))
    kind = "mock bench" if bench.mock else "LAB BENCH"
    parts = [row.name for row in bench.rows]
    print(f"{kind} {file.path}: {', '.join(parts)}; nothing moves", flush=True)
    logging.getLogger("rig").setLevel(logging.ERROR)
    faults = 0
    with (
        tempfile.TemporaryDirectory(prefix="tactile-rig-") as folder,
        started_bench(file) as on,
    ):
        for found in examine(on.file.bench, Path(folder), options.out, SystemClock(), on.watch):
            faults += found.state == "FAULT"
            show(found)
    if faults:
        out = None if options.out == SESSIONS else options.out
        again = bench_command("doctor", options, out=out)
        print(f"doctor: {faults} fault{'s' * (faults > 1)}; again: {again}")
        return EXIT_DEVICE_LOST
    if store.acceptance_of(options.calibrations, bench) is None:
        elsewhere = options.calibrations != store.FOLDER
        kept = options.calibrations if elsewhere else None
        following = bench_command("setup", options, calibrations=kept)
    else:
        following = bench_command("collect", options, targets=2)
    print(f"doctor: no fault; next: {following}")
    return EXIT_DONE


def show(found: Finding) -> None:
    """Print a finding, and its cures."""
    print(f"  {found.state:5}  {found.part:10} {found.text}", flush=True)
    for number, cure in enumerate(found.cures):
        print(f"         {'' if number else 'cure:':10} {cure}", flush=True)


def fix(bench: Bench, user: str, etc: Path) -> int:
    """Write the files of `missing_rights` after asking; return the exit code."""
    files = missing_rights(bench, user, etc)
    if not files:
        print(f"doctor: {user} has these rights already")
        return EXIT_DONE
    lines = [f"{path}:\n  {text}" for path, text in files.items()]
    if not os.access(etc, os.W_OK):
        again = shlex.join(["sudo", *sys.argv])
        raise ConfigError(
            f"--fix: {etc} needs root; {again} writes\n" + "".join(lines).rstrip("\n")
        )
    if not sys.stdin.isatty():
        raise ConfigError("--fix: asks before it writes, and there is no terminal to ask on")
    confirm([f"This writes for {user}:", *lines], "write")
    for path, text in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        print(f"{path}: written")
    print("doctor: log in again, and plug pedal and SpaceMouse in again")
    return EXIT_DONE
