"""`tactile calibrate-latency`: measure the signal's latency by light taps."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

from recorder import Session
from recorder.command_line.errors import EXIT_DONE, EXIT_SAFETY_STOP
from recorder.command_line.options import positive
from rig.acquire.calibration import store
from rig.acquire.calibration.calibration import LatencyCalibration
from rig.cli.options import (
    banner,
    bench_options,
    calibration_of,
    calibration_options,
    chosen_bench,
    free_path,
)
from rig.core.clock import file_stamp
from rig.core.config import to_si
from rig.core.errors import SafetyStop


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    bench_options(parser)
    parser.add_argument("--indenter", help="name of the indenter on the arm")
    parser.add_argument("--taps", type=int, default=16, help="number of taps (%(default)s)")
    parser.add_argument(
        "--width-ms",
        type=positive,
        default=2.0,
        metavar="MS",
        help="allowed width of the 95 %% interval [ms] (%(default)s)",
    )
    parser.add_argument(
        "--depth-mm", type=float, help="deepest tap [mm] (default: the depth of 1 N, at most 1.0)"
    )
    parser.add_argument("--out", type=Path, help="session to write (default: in sessions/)")
    parser.add_argument("--operator", default="", help="operator's name (default: the login name)")
    calibration_options(parser)


def run(options: argparse.Namespace) -> int:
    """Tap, correlate and store the result; return the exit code.

    Raises:
        ConfigError, DeviceLost, SafetyStop, SessionError: Nothing was stored.
    """
    from rig.acquire.calibration import latency
    from rig.acquire.request import CollectRequest, plan_of
    from rig.cli.recording import record

    file = chosen_bench(options).with_indenter(options.indenter or "")
    bench = file.bench
    print(banner(file), flush=True)
    # Apply the surface calibration only: an old latency correction would bias the new measurement.
    home = dataclasses.replace(calibration_of(options, bench), latency=None)
    stream = latency.signal_of(bench)
    depth = None if options.depth_mm is None else to_si(options.depth_mm, "mm")
    plan = latency.plan_for(bench, depth=depth, count=options.taps)
    stamp = file_stamp()
    session_path = options.out or free_path(
        Path("sessions") / f"{bench.sensor}-latency-{stamp}.zarr"
    )
    request = CollectRequest(path=session_path, operator=options.operator, calibration=home)
    plan_of(request, home.applied(bench), plan)
    code = record(file, request, plan, prepared=home.applied)
    if code != EXIT_DONE:
        print("calibrate-latency: not finished, nothing is stored; repeat the command")
        return code
    session = Session(session_path)
    try:
        found = latency.evaluate(session, stream, latency.exposure_of(bench, stream))
    except SafetyStop as error:
        print(f"{error}; nothing is stored; the taps are in {session_path}")
        return EXIT_SAFETY_STOP
    print("\n".join(latency.lines_of(found, session)))
    rejected = latency.refusal(found, width_max=1e-3 * options.width_ms)
    if rejected is not None:
        print(f"calibrate-latency: refused, nothing is stored: {rejected}")
        return EXIT_SAFETY_STOP
    measured = LatencyCalibration(
        date_utc=store.now_utc(),
        method=latency.METHOD,
        mock=bench.mock,
        bench_sha256=store.bench_hash(file.content),
        stream=stream,
        device=store.device_name(bench, stream),
        latency=found.latency,
        interval=(found.latency - found.half, found.latency + found.half),
        exposure=found.exposure,
        gel_lead=found.gel.value,
        ratio=found.image.ratio,
        taps=found.image.taps,
    )
    stored = store.store(options.calibrations, bench.sensor, latency=measured)
    print(f"calibrate-latency: stored in {stored}")
    return EXIT_DONE
