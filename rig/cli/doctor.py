"""`tactile doctor`: test a bench's devices, its plan, and the computer; nothing moves."""

import argparse
import logging
import tempfile
from pathlib import Path

from recorder.command_line.errors import EXIT_DEVICE_LOST, EXIT_DONE
from recorder.command_line.options import add_value
from recorder.command_line.terminal import State, paint, wrapped
from rig.acquire.calibration import store
from rig.acquire.doctor import Finding, examine
from rig.cli.options import bench_command, bench_options, calibration_options, chosen_bench
from rig.cli.recording import started_bench
from rig.core.clock import SystemClock

_COLOURS: dict[str, State] = {"well": "good", "note": "note", "FAULT": "fault"}
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
    about = "folder of sessions, whose disk is tested, and of the plan's picture"
    add_value(parser, "--out", "DIR", SESSIONS, about, Path)
    calibration_options(parser)


def run(options: argparse.Namespace) -> int:
    """Print a line for each part, and its cures; return the exit code."""
    file = chosen_bench(options)
    bench = file.bench
    kind = "mock bench" if bench.mock else "LAB BENCH"
    parts = [row.name for row in bench.rows]
    print(f"{kind} {file.path}: {', '.join(parts)}; nothing moves", flush=True)
    logging.getLogger("rig").setLevel(logging.ERROR)
    faults = 0
    with tempfile.TemporaryDirectory(prefix="tactile-rig-") as folder, started_bench(file) as on:
        for finding in examine(on.file.bench, Path(folder), options.out, SystemClock(), on.watch):
            faults += finding.state == "FAULT"
            show(finding)
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
    state = paint(f"{found.state:5}", _COLOURS[found.state])
    print(wrapped(found.text, f"  {state}  {found.part:10} "), flush=True)
    for number, cure in enumerate(found.cures):
        print(f"         {'' if number else 'cure:':10} {cure}", flush=True)
