"""`tactile home`: find the surface by touch and store its position."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from recorder import Session
from recorder.command_line.errors import EXIT_DONE, EXIT_SAFETY_STOP
from rig.acquire.calibration import store
from rig.bench.bench import BenchFile
from rig.cli.options import (
    banner,
    bench_options,
    calibration_options,
    chosen_bench,
    free_path,
)
from rig.cli.terminal import require_terminal
from rig.core.clock import file_stamp
from rig.core.config import to_si
from rig.core.errors import SafetyStop


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    bench_options(parser)
    parser.add_argument("--indenter", help="name of the indenter on the arm")
    parser.add_argument("--repeats", type=int, default=4, help="approaches per point (%(default)s)")
    parser.add_argument(
        "--force-n", type=float, default=0.3, help="back off at this force [N] (%(default)s)"
    )
    parser.add_argument(
        "--travel-mm",
        type=float,
        help="distance to go below the assumed surface [mm] (1.0, or the bench's depth limit)",
    )
    parser.add_argument(
        "--width-mm",
        type=float,
        default=0.05,
        help="reject a 95 %% interval wider than this [mm] (%(default)s)",
    )
    parser.add_argument("--corners", action="store_true", help="also touch four corners, for tilt")
    parser.add_argument("--out", type=Path, help="session to write (default: in sessions/)")
    parser.add_argument("--operator", default="", help="operator's name (default: the login name)")
    calibration_options(parser)


def run(options: argparse.Namespace) -> int:
    """Touch, fit and store the result; return the exit code.

    Raises:
        ConfigError, DeviceLost, SafetyStop, SessionError: Nothing was stored.
    """
    from rig.acquire.calibration import home
    from rig.acquire.calibration.calibration import Calibration, require_gauge
    from rig.acquire.request import CollectRequest, plan_of
    from rig.cli.recording import record

    file = chosen_bench(options).with_indenter(options.indenter or "")
    bench = file.bench
    print(banner(file), flush=True)
    acceptance = store.acceptance_of(options.calibrations, bench)
    if bench.no_gauge:
        return _by_signal(options, file, acceptance)
    require_gauge(bench, "home")
    points = (1, 2, 3, 4, 5) if options.corners else (1,)
    travel = None if options.travel_mm is None else to_si(options.travel_mm, "mm")
    plan = home.plan_for(bench, travel=travel, repeats=options.repeats, points=points)
    touching = home.touching_bench(bench, options.force_n)
    session = options.out or free_path(home.default_path(bench.sensor, file_stamp()))
    request = CollectRequest(
        path=session, operator=options.operator, calibration=Calibration(acceptance=acceptance)
    )
    # Checked against the bench's own limits, since each approach is ended by the lower soft limit.
    plan_of(request, bench, plan)
    code = record(
        file,
        request,
        plan,
        prepared=lambda ready: home.touching_bench(ready, options.force_n),
    )
    if code != EXIT_DONE:
        print("home: not finished, nothing is stored; repeat the command")
        return code
    try:
        found = home.evaluate(Session(session), plan, width_max=to_si(options.width_mm, "mm"))
    except SafetyStop as error:
        print(f"{error}; nothing is stored; the approaches are in {session}")
        return EXIT_SAFETY_STOP
    print("\n".join(home.lines_of(found, bench)))
    measured = home.calibration_from(found, touching, file.content)
    stored = store.store(options.calibrations, bench.sensor, home={bench.indenter: measured})
    print(f"home: stored in {stored}")
    return EXIT_DONE


def _by_signal(
    options: argparse.Namespace,
    file: BenchFile,
    acceptance: dict[str, Any] | None,
) -> int:
    """Find the surface without a gauge, and store it; return the exit code."""
    from rig.acquire import no_gauge
    from rig.cli import without_gauge
    from rig.cli.recording import started_bench

    bench = file.bench
    if not bench.mock:
        require_terminal()
    folder = Path("sessions") if options.out is None else options.out
    folder.mkdir(parents=True, exist_ok=True)
    with started_bench(file) as on:
        stages = without_gauge.StageRecorder(file, folder, on, options.operator, acceptance)
        try:
            home = no_gauge.find_surface(bench, file.content, stages)
        except no_gauge.StageStopped as stopped:
            print("home: not finished, nothing is stored; repeat the command")
            return stopped.code
    stored = store.store(options.calibrations, bench.sensor, home={bench.indenter: home})
    print(f"home: stored in {stored}")
    return EXIT_DONE
