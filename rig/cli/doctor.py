"""`python -m rig doctor`: test every device of a bench, and the computer; nothing moves."""

from __future__ import annotations

import argparse
import logging
import tempfile
from pathlib import Path

from recorder.command_line.errors import EXIT_DEVICE_LOST, EXIT_DONE
from rig.acquire.doctor import examine
from rig.bench.bench import bench_from
from rig.cli.options import bench_options, chosen_bench
from rig.cli.recording import started_bench
from rig.core.clock import SystemClock


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    bench_options(parser)
    parser.description = (
        "Tests all devices of a bench at once, and the computer: answers, rates, values at rest, "
        "disk, real-time rights, clock. Each fault comes with its cure. Nothing moves; leave the "
        "sensor without contact. A mock bench starts its emulators. Exit code 0 if there is no "
        "fault, 2 wrong input, 3 a fault."
    )
    parser.epilog = "Example: tactile doctor --sensor tacpalm"
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("sessions"),
        metavar="DIR",
        help="folder of sessions, whose disk is tested (%(default)s)",
    )


def run(options: argparse.Namespace) -> int:
    """Print a line for each part, and its cures; return the exit code."""
    path, bench, content = chosen_bench(options)
    kind = "mock bench" if bench.mock else "LAB BENCH"
    parts = [row.name for row in bench.rows]
    print(f"{kind} {path}: {', '.join(parts)}; nothing moves", flush=True)
    logging.getLogger("rig").setLevel(logging.ERROR)
    faults = 0
    with (
        tempfile.TemporaryDirectory(prefix="tactile-rig-") as folder,
        started_bench(path, content) as on,
    ):
        ready = bench_from(on.content, str(path))
        for found in examine(ready, Path(folder), options.out, SystemClock(), on.watch):
            faults += found.state == "FAULT"
            print(f"  {found.state:5}  {found.part:10} {found.text}", flush=True)
            for number, cure in enumerate(found.cures):
                print(f"         {'' if number else 'cure:':10} {cure}", flush=True)
    name = f"--sensor {options.sensor}" if options.sensor else f"--bench {path}"
    if faults:
        print(f"doctor: {faults} fault{'s' * (faults > 1)}; again: tactile doctor {name}")
        return EXIT_DEVICE_LOST
    print(f"doctor: no fault; next: tactile collect {name} --targets 2")
    return EXIT_DONE
