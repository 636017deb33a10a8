"""The way of all commands that record: bench, plan, question, emulators, collector, evaluation.

`collect` records the plan of a bench, `record` any plan, and `stage` one of several.
"""

import argparse
import contextlib
import dataclasses
import functools
import math
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from recorder.command_line.errors import EXIT_DONE, EXIT_SAFETY_STOP
from recorder.command_line.options import next_command
from recorder.session import Session
from rig.acquire.calibration import store
from rig.acquire.calibration.store import Calibration
from rig.acquire.collector import Collector, CollectRequest
from rig.bench import guards
from rig.bench.bench import Bench, BenchFile
from rig.bench.worlds import Sources
from rig.cli.options import (
    banner,
    bench_choice,
    chosen_bench,
    confirm,
    free_path,
    logged_to,
    motion_lines,
    opened_page,
    require_terminal,
)
from rig.core.clock import file_stamp
from rig.core.errors import DeviceLost, SafetyStop
from rig.core.load import explained
from rig.monitor.access import AccessPolicy
from trajectories import ForceDepth, Plan, PressShear, Target


@dataclass(frozen=True, slots=True)
class StartedBench:
    """A bench that is ready to record one session after the other."""

    file: BenchFile
    """Its file, with the addresses of a mock bench's emulators."""
    watch: Callable[[], None] | None
    """Raises if an emulator of a mock bench is gone."""


@contextlib.contextmanager
def started_bench(
    file: BenchFile,
    *,
    sources: Sources | None = None,
    truth: Path | None = None,
    folder: Path | None = None,
) -> Iterator[StartedBench]:
    """Start the emulators of a mock bench for the context; a lab bench needs nothing.

    The emulators play `sources`, log the World's truth to the file `truth`, and keep their files in
    `folder`, by default a temporary one. A busy computer is named in the context's errors.
    """
    try:
        with contextlib.ExitStack() as stack:
            if not file.bench.mock:
                yield StartedBench(file, None)
                return
            # Imported here, so that a collection on lab devices loads no emulator.
            from rig.mock.bench import MockBench

            if folder is None:
                temporary = tempfile.TemporaryDirectory(prefix="tactile-rig-")
                folder = Path(stack.enter_context(temporary))
            mock = MockBench(file, folder, sources=sources, truth=truth)
            stack.enter_context(mock)
            yield StartedBench(mock.file, mock.check)
    except DeviceLost as error:
        raise explained(error, mock=file.bench.mock) from error


@dataclass(frozen=True, slots=True)
class Recording:
    """Bench and places of results that all commands that record have."""

    file: BenchFile
    """The bench, with the indenter on its arm."""
    calibrations: Path = store.FOLDER
    operator: str = ""
    """Name of the operator; empty: the login name."""
    out: Path | None = None
    """Session to write; None: one in sessions/."""
    agreed: bool = False
    """True if the operator of a campaign has agreed to the motion of its sessions."""
    chosen: Mapping[str, object] = field(default_factory=dict)
    """Options that choose the bench, for commands to continue with."""
    on: StartedBench | None = None
    """The bench, if it has been started."""

    @property
    def bench(self) -> Bench:
        """The bench as its file describes it."""
        return self.file.bench

    def session(self, *parts: str) -> Path:
        """Return the session to write: `out`, or one of sensor, `parts` and time in sessions/."""
        name = "-".join([self.bench.sensor, *parts, file_stamp()])
        return self.out or free_path(Path("sessions") / f"{name}.zarr")

    def calibration(self, resumed: Path | None = None) -> Calibration:
        """Load and print the calibration: from the store, or that of the session to resume."""
        warnings: list[str] = []
        if resumed is not None:
            calibration = Calibration.from_attrs(Session(resumed).attrs.get("calibration") or {})
        else:
            calibration, warnings = store.load(self.calibrations, self.bench, self.bench.indenter)
        for line in (*calibration.lines(), *(f"warning: {warning}" for warning in warnings)):
            print(line, flush=True)
        return calibration

    def uncalibrated(self) -> Calibration:
        """Return the calibration of a session that measures one: only the bench's acceptance."""
        return Calibration(acceptance=store.acceptance_of(self.calibrations, self.bench))

    def resume(self, session: Path) -> str:
        """Return the command that continues a stopped session."""
        return next_command("collect", resume=session, bench=self.chosen.get("bench"))


def recording_of(options: argparse.Namespace) -> Recording:
    """Return what the options of a command that records say, and print which bench it is."""
    file = chosen_bench(options)
    print(banner(file), flush=True)
    resumed = getattr(options, "resume", None)
    indenter = str(Session(resumed).attrs["indenter"]) if resumed else options.indenter
    return Recording(
        file.with_indenter(indenter),
        options.calibrations,
        options.operator,
        options.out,
        chosen=bench_choice(options),
    )


def record(
    recording: Recording,
    request: CollectRequest,
    *,
    prepare: Callable[[Bench], Bench] | None = None,
    sources: Sources | None = None,
    truth: Path | None = None,
    watch: AccessPolicy | None = None,
) -> int:
    """Record a plan from its first open target on, and return the collector's exit code.

    `prepare` returns the final bench: speeds, limits, calibrated frame; None: the request's
    calibration is applied. The mock's World does not see these changes. `watch` is the address of
    the monitoring page.
    """
    prepared, reaction = prepare or request.calibration.applied, request.calibration.reaction

    def prepare_gently(bench: Bench) -> Bench:
        return guards.gentle(prepared(bench), reaction)

    bench, depth = prepare_gently(recording.bench), request.depth(recording.bench)
    if not bench.no_gauge and isinstance(request.plan, PressShear | ForceDepth):
        print("\n".join(guards.lines(bench, depth, request.left_out)), flush=True)
    if not bench.mock and not recording.agreed:
        confirm(motion_lines(bench, depth))
    request.path.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        stack.enter_context(logged_to(request.path))
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tactile-rig-")))
        on = recording.on or stack.enter_context(
            started_bench(recording.file, sources=sources, truth=truth, folder=folder)
        )
        bench = prepare_gently(on.file.bench)
        page = None
        if watch is not None:
            page = stack.enter_context(
                opened_page(watch, recording.calibrations, bench, folder, request)
            )
        return Collector(bench, on.file.content, folder, on.watch, page).run(request)


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

            depth = request.depth(bench)
            if not bench.mock:
                require_terminal()
            print("\n".join(guards.lines(bench, depth, request.left_out)), flush=True)
            if not bench.mock:
                hint = next_command("home", **recording.chosen, indenter=bench.indenter)
                no_gauge.check_home(bench, calibration, hint)
            session.parent.mkdir(parents=True, exist_ok=True)
            stack.enter_context(logged_to(session))
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


class StageStopped(Exception):
    """A stage was stopped; `code` is the exit code."""

    def __init__(self, code: int) -> None:
        super().__init__(f"exit code {code}")
        self.code = code


def stage(
    recording: Recording,
    folder: Path,
    what: str,
    plan: Plan,
    prepared: Callable[[Bench], Bench],
    *,
    contact_change: float = math.inf,
    after_target: Callable[[Target, Session], None] | None = None,
) -> Session:
    """Record a stage on a started bench in a folder; see `rig.acquire.no_gauge.Record`."""
    bench = recording.bench
    path = free_path(folder / f"{bench.sensor}-{what}-{file_stamp()}.zarr")

    def after(target: Target) -> None:
        if after_target is not None:
            after_target(target, Session(path))

    request = CollectRequest.of(
        bench,
        path,
        plan,
        operator=recording.operator,
        calibration=recording.uncalibrated(),
        contact_change=contact_change,
        after_target=None if after_target is None else after,
    )
    prepared(bench).check_limits(plan)
    code = record(recording, request, prepare=prepared)
    if code != EXIT_DONE:
        raise StageStopped(code)
    return Session(path)


def measured(name: str, session: Path, code: int, measure: Callable[[Session], Path]) -> int:
    """Measure from a session whose collection ended with `code`, and return the exit code.

    `measure` returns the file in which it stored the result of the command `name`.
    """
    if code != EXIT_DONE:
        print(f"{name}: not finished, nothing is stored; repeat the command")
        return code
    try:
        print(f"{name}: stored in {measure(Session(session))}")
    except SafetyStop as error:
        print(f"{error}; nothing is stored; what was recorded is in {session}")
        return EXIT_SAFETY_STOP
    return EXIT_DONE
