"""`tactile force-depth`: press straight down and up again; print a table and a curve."""

from __future__ import annotations

import argparse
from pathlib import Path

from recorder.command_line.options import next_command
from rig.cli.options import (
    banner,
    bench_options,
    calibration_of,
    calibration_options,
    chosen_bench,
    confirm_options,
    free_path,
)
from rig.core.clock import file_stamp
from rig.core.errors import ConfigError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    bench_options(parser)
    parser.add_argument(
        "--indenter", default="prism", help="name of the indenter on the arm (%(default)s)"
    )
    parser.add_argument("--out", type=Path, help="session to write (default: in sessions/)")
    parser.add_argument("--operator", default="", help="operator's name (default: the login name)")
    calibration_options(parser)
    confirm_options(parser)


def run(options: argparse.Namespace) -> int:
    """Press, print and draw; return the exit code.

    Raises:
        ConfigError, DeviceLost, SafetyStop, SessionError: Before anything was recorded.
    """
    from rig.acquire.calibration.calibration import require_gauge
    from rig.acquire.request import CollectRequest, plan_of
    from rig.acquire.summary import show_curve
    from rig.cli.recording import record

    file = chosen_bench(options)
    path, bench = file.path, file.bench
    print(banner(file), flush=True)
    if bench.force_depth is None:
        raise ConfigError(
            f"{path}.force_depth: missing; allowed: depth_max_mm, repeats "
            "(see docs/how-to/set-up-a-bench.md)"
        )
    require_gauge(bench, "force-depth")
    plan = bench.force_depth
    file = file.with_indenter(options.indenter)
    calibration = calibration_of(options, file.bench)
    name = f"{bench.sensor}-{file.bench.indenter}-force-depth-{file_stamp()}.zarr"
    session = options.out or free_path(Path("sessions") / name)
    request = CollectRequest(
        path=session,
        operator=options.operator,
        calibration=calibration,
        go_on=next_command("collect", resume=session, bench=options.bench),
    )
    plan_of(request, calibration.applied(bench), plan)
    code = record(file, request, plan, prepared=calibration.applied, asked_by=options.asked_by)
    show_curve(session)
    return code
