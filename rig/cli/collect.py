"""`tactile collect`: record one session, or resume one."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
from pathlib import Path

from recorder.command_line.errors import EXIT_DONE
from recorder.command_line.options import next_command
from rig.bench.bench import Bench
from rig.bench.no_gauge import planned_depth, slowed
from rig.cli.options import (
    add_page,
    banner,
    bench_options,
    calibration_of,
    calibration_options,
    check_page,
    chosen_bench,
    confirm_options,
    free_path,
    log_to,
    opened_page,
    resumed_indenter,
    sources_of,
)
from rig.cli.terminal import require_terminal
from rig.core.clock import file_stamp
from rig.core.errors import ConfigError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    bench_options(parser, sources=True).add_argument(
        "--truth",
        type=Path,
        metavar="FILE",
        help="write the simulated contact's true motion and forces",
    )
    parser.description = (
        "Records one session: checks the rates of all streams, tares the gauge, and "
        "presses the targets of the bench's plan. Ctrl-C stops after the current move and loses "
        "nothing; --resume continues. Exit code 0 done, 2 wrong input, 3 device lost, 4 safety "
        "stop, 130 interrupted."
    )
    parser.epilog = "Example: tactile collect --sensor tacpalm --targets 8"
    group = parser.add_argument_group("session")
    group.add_argument(
        "--out", type=Path, metavar="PATH", help="session to write (default: in sessions/)"
    )
    group.add_argument(
        "--resume",
        type=Path,
        metavar="PATH",
        help="continue this stopped session (which names its sensor)",
    )
    group.add_argument(
        "--again",
        type=target_numbers,
        default=(),
        metavar="N,N,...",
        help="with --resume: press these targets again, numbered from 1 as on the page; the last "
        "press counts",
    )
    group.add_argument("--targets", type=int, metavar="N", help="press only the first N targets")
    group.add_argument("--indenter", metavar="NAME", help="name of the indenter on the arm")
    group.add_argument(
        "--operator", default="", metavar="NAME", help="operator's name (default: the login name)"
    )
    add_page(parser, "--watch", "serve a page to watch, pause and abort")
    calibration_options(parser)
    confirm_options(parser)


def target_numbers(text: str) -> tuple[int, ...]:
    """Read numbers of targets from 1, as `3,7`, and return their indices from 0.

    Raises:
        argparse.ArgumentTypeError: The text is no such list.
    """
    try:
        numbers = [int(word) for word in text.split(",")]
    except ValueError:
        numbers = [0]
    if min(numbers) < 1:
        raise argparse.ArgumentTypeError(f"found {text!r}; allowed: numbers from 1, as 3,7")
    return tuple(number - 1 for number in numbers)


def run(options: argparse.Namespace) -> int:
    """Collect; return the exit code.

    Raises:
        ConfigError, DeviceLost, SafetyStop, SessionError: Before anything was recorded.
    """
    from rig.acquire import no_gauge
    from rig.acquire.request import CollectRequest, is_complete, plan_of
    from rig.cli import without_gauge
    from rig.cli.recording import record, started_bench

    file = chosen_bench(options)
    print(banner(file), flush=True)
    if options.resume and (options.out or options.targets or options.indenter):
        raise ConfigError(
            "--resume: neither --out, --targets nor --indenter go with it: the session has them"
        )
    if options.again and not options.resume:
        raise ConfigError("AGAIN, --again: goes with RESUME, --resume, only")
    file = file.with_indenter(options.indenter or resumed_indenter(options))
    path, bench = file.path, file.bench
    sources = sources_of(options, file)
    if not bench.mock and options.truth:
        raise ConfigError(f"TRUTH: {path} is a lab bench; allowed: a mock bench")
    check_page("--watch", options.watch)
    session = options.resume or options.out
    if session is None:
        name = f"{bench.sensor}-{bench.indenter}-{file_stamp()}.zarr"
        session = free_path(Path("sessions") / name)
    calibration = calibration_of(options, bench)
    request = CollectRequest(
        path=session,
        resume=options.resume is not None,
        again=options.again,
        targets=options.targets,
        operator=options.operator,
        mock_sources=sources.description() if bench.mock else None,
        calibration=calibration,
        go_on=next_command("collect", resume=session, bench=options.bench),
    )
    plan, total = plan_of(request, calibration.applied(bench))
    if request.resume and not request.again and is_complete(session, plan, total):
        print(f"complete: all {total} targets are done; {session} is left as it is")
        return EXIT_DONE
    depth = planned_depth(bench, plan, total)
    if bench.no_gauge:
        if not bench.mock:
            require_terminal()
        without_gauge.check_before(options, bench, calibration, depth)
    with contextlib.ExitStack() as stack:
        on = None
        if bench.no_gauge:
            session.parent.mkdir(parents=True, exist_ok=True)
            log_to(session.with_suffix(".log"))
            on = stack.enter_context(started_bench(file, sources=sources, truth=options.truth))
            try:
                if not request.resume:
                    stages = without_gauge.StageRecorder(
                        file,
                        session.parent,
                        on,
                        options.operator,
                        calibration.acceptance,
                    )
                    calibration = without_gauge.prepare(options, stages, calibration, depth)
            except no_gauge.StageStopped as stopped:
                print("collect: a stage before the plan was stopped; nothing was collected")
                return stopped.code
            request = dataclasses.replace(request, calibration=calibration)

        def prepared(ready: Bench) -> Bench:
            placed = calibration.applied(ready)
            return slowed(placed, depth) if ready.no_gauge else placed

        return record(
            file,
            request,
            plan,
            total=total,
            prepared=prepared,
            asked_by=options.asked_by,
            sources=sources,
            truth=options.truth,
            page=lambda ready, folder: opened_page(options, ready, folder, request, plan, total),
            on=on,
        )
