"""`tactile home`: find the surface by touch and store its position."""

import argparse
import dataclasses
import functools
from pathlib import Path

from recorder.command_line.errors import EXIT_DONE
from recorder.session import Session
from rig.acquire.calibration import home, store
from rig.acquire.calibration.store import require_gauge
from rig.acquire.collector import CollectRequest
from rig.cli.options import recording_options, require_terminal
from rig.cli.recording import (
    Recording,
    StageStopped,
    measured,
    record,
    recording_of,
    stage,
    started_bench,
)
from rig.core.config import to_si


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    recording_options(parser)
    parser.add_argument("--repeats", type=int, default=4, help="approaches per point (%(default)s)")
    parser.add_argument(
        "--force-n",
        type=float,
        help="back off at this force [N] (0.3, or half of that expected at the end)",
    )
    parser.add_argument(
        "--travel-mm",
        type=float,
        help="distance to go below the assumed surface [mm] (1.0, or where the force is expected)",
    )
    parser.add_argument("--corners", action="store_true", help="also touch four corners, for tilt")


def run(options: argparse.Namespace) -> int:
    """Touch, fit and store the result; return the exit code."""
    recording = recording_of(options)
    if recording.bench.no_gauge:
        return find_by_signal(recording)
    travel = None if options.travel_mm is None else to_si(options.travel_mm, "mm")
    return find_by_force(
        recording,
        repeats=options.repeats,
        force=options.force_n,
        travel=travel,
        corners=options.corners,
    )


def find_by_force(
    recording: Recording,
    *,
    repeats: int = 4,
    force: float | None = None,
    travel: float | None = None,
    corners: bool = False,
) -> int:
    """Find and store the surface by slow approaches; return the exit code.

    Each goes `travel` below the assumed surface [m], by default 1 mm or the bench's limit, and ends
    at `force` [N], by default 0.3 N or less on a soft skin. With `corners`, four
    corners are touched too, for the tilt.
    """
    bench = recording.bench
    require_gauge(bench, "home")
    points = (1, 2, 3, 4, 5) if corners else (1,)
    most = home.force_of(bench, travel) if force is None else force
    plan = home.plan_for(bench, force=most, travel=travel, repeats=repeats, points=points)
    home.touching_bench(bench, most)
    path = recording.session("home")
    # Checked against the bench's own limits, since each approach is ended by the lower soft limit.
    request = CollectRequest.of(
        bench, path, plan, operator=recording.operator, calibration=recording.uncalibrated()
    )

    def stored(session: Session) -> Path:
        approaches = home.evaluate(session, plan)
        print("\n".join(home.lines_of(approaches, bench)))
        surface = home.home_calibration(home.METHOD, approaches, recording.file)
        return store.store(recording.calibrations, bench.sensor, home={bench.indenter: surface})

    code = record(recording, request, prepare=lambda ready: home.touching_bench(ready, most))
    return measured("home", path, code, stored)


def find_by_signal(recording: Recording) -> int:
    """Find and store the surface without a gauge, by sessions in `out`; return the exit code."""
    from rig.acquire import no_gauge

    if not recording.bench.mock:
        require_terminal()
    folder = Path("sessions") if recording.out is None else recording.out
    folder.mkdir(parents=True, exist_ok=True)
    with started_bench(recording.file) as on:
        started = dataclasses.replace(recording, on=on)
        try:
            surface = no_gauge.find_surface(
                recording.file, functools.partial(stage, started, folder)
            )
        except StageStopped as stopped:
            print("home: not finished, nothing is stored; repeat the command")
            return stopped.code
    bench = recording.bench
    file = store.store(recording.calibrations, bench.sensor, home={bench.indenter: surface})
    print(f"home: stored in {file}")
    return EXIT_DONE
