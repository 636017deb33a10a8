"""`tactile collect`: record one session, or resume one."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

from recorder.command_line.errors import EXIT_DONE
from rig.acquire.calibration.store import Calibration
from rig.acquire.request import CollectRequest, StageStopped
from rig.bench import guards
from rig.bench.bench import Bench
from rig.bench.worlds import Sources
from rig.cli.options import (
    add_page,
    check_page,
    confirm,
    log_to,
    recording_options,
    require_terminal,
    sources_of,
)
from rig.cli.recording import Recording, record, recording_of, stage, started_bench
from rig.core.errors import ConfigError
from rig.monitor.access import AccessPolicy


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    recording_options(parser, sources=True).add_argument(
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
    add_page(parser, "--watch", "serve a page to watch, pause and abort")


def target_numbers(text: str) -> tuple[int, ...]:
    """Read numbers of targets from 1, as `3,7`, and return their indices from 0."""
    try:
        numbers = [int(word) for word in text.split(",")]
    except ValueError:
        numbers = [0]
    if min(numbers) < 1:
        raise argparse.ArgumentTypeError(f"found {text!r}; allowed: numbers from 1, as 3,7")
    return tuple(number - 1 for number in numbers)


def run(options: argparse.Namespace) -> int:
    """Collect; return the exit code."""
    if options.resume and (options.out or options.targets or options.indenter):
        raise ConfigError(
            "--resume: neither --out, --targets nor --indenter go with it: the session has them"
        )
    if options.again and not options.resume:
        raise ConfigError("--again: goes with --resume only")
    recording = recording_of(options)
    sources = sources_of(options, recording.file)
    if not recording.bench.mock and options.truth:
        raise ConfigError(f"--truth: {recording.file.path} is a lab bench; allowed: a mock bench")
    check_page("--watch", options.watch)
    return collect(
        recording,
        targets=options.targets,
        resumed=options.resume,
        again=options.again,
        sources=sources,
        truth=options.truth,
        watch=options.watch,
    )


def collect(
    recording: Recording,
    *,
    targets: int | None = None,
    resumed: Path | None = None,
    again: tuple[int, ...] = (),
    sources: Sources | None = None,
    truth: Path | None = None,
    watch: AccessPolicy | None = None,
) -> int:
    """Record a session along the bench's plan, or resume one; return the exit code.

    Of a resumed session, the targets with the indices `again` are pressed again. A mock bench plays
    `sources`, and logs the World's truth to a file. `watch` is the address of the monitoring page.
    """
    bench, sources = recording.bench, sources or Sources()
    session = resumed or recording.session(bench.indenter)
    calibration = recording.calibration(resumed)
    request = CollectRequest.of(
        bench,
        session,
        targets=targets,
        resume=resumed is not None,
        again=again,
        operator=recording.operator,
        mock_sources=sources.description() if bench.mock else None,
        calibration=calibration,
        go_on=recording.resume(session),
    )
    if request.resume and not again and request.is_complete():
        print(f"complete: all {request.total} targets are done; {session} is left as it is")
        return EXIT_DONE
    with contextlib.ExitStack() as stack:
        prepare: Callable[[Bench], Bench] | None = None
        if bench.no_gauge:
            from rig.acquire import no_gauge

            depth = guards.planned_depth(bench, request.plan, request.total)
            if not bench.mock:
                require_terminal()
            guards.check_plan(bench, depth)
            print("\n".join(guards.lines(bench, depth)), flush=True)
            if not bench.mock:
                hint = recording.next("home", indenter=bench.indenter)
                no_gauge.check_home(bench, calibration, hint)
            session.parent.mkdir(parents=True, exist_ok=True)
            log_to(session.with_suffix(".log"))
            on = stack.enter_context(started_bench(recording.file, sources=sources, truth=truth))
            recording = dataclasses.replace(recording, on=on)
            try:
                if not request.resume:
                    calibration = no_gauge.prepare(
                        recording.file,
                        recording.calibrations,
                        calibration,
                        depth,
                        functools.partial(stage, recording, session.parent),
                        _show if bench.mock else confirm,
                    )
            except StageStopped as stopped:
                print("collect: a stage before the plan was stopped; nothing was collected")
                return stopped.code
            request = dataclasses.replace(request, calibration=calibration)
            prepare = functools.partial(_slowed, calibration, depth)
        return record(
            recording, request, prepare=prepare, sources=sources, truth=truth, watch=watch
        )


def _slowed(calibration: Calibration, depth: float, bench: Bench) -> Bench:
    return guards.slowed(calibration.applied(bench), depth)


def _show(lines: list[str]) -> None:
    print("\n".join(lines), flush=True)
