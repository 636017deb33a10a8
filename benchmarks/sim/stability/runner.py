"""Run hard cases in several parallel processes, and judge them by their laws alone."""

from __future__ import annotations

import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

from benchmarks.sim.stability.case import Case, Solver
from benchmarks.sim.stability.catalogue import BY_NAME
from benchmarks.sim.stability.laws import Law
from benchmarks.sim.stability.planted import planted
from recorder.processes import Workers
from recorder.progress import duration
from sim.errors import SimulationDiverged

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


@dataclass(frozen=True, slots=True)
class Report:
    """Result of one case."""

    name: str
    laws: tuple[Law, ...]
    seconds: float
    """Wall time."""
    trouble: str = ""
    """Reason for missing laws: no converged state, or a crash."""

    @property
    def passed(self) -> bool:
        """True if laws were measured and all hold."""
        return bool(self.laws) and not self.trouble and all(law.holds for law in self.laws)

    @property
    def failures(self) -> list[str]:
        """Each law that does not hold, or the trouble."""
        reported = [self.trouble] if self.trouble else []
        reported += [str(law) for law in self.laws if not law.holds]
        return reported or ([] if self.laws else ["no law was measured"])


def run_case(name: str, device: str, mistake: str | None) -> Report:
    """Run one case in this process; any exception counts as its failure and affects no other case.

    A bug is injected into this process, which may be a worker, and removed when the case ends.
    """
    began = time.perf_counter()
    laws: tuple[Law, ...] = ()
    trouble = ""
    try:
        with planted(mistake):
            laws = tuple(BY_NAME[name].run(Solver(device)))
    except SimulationDiverged as diverged:
        trouble = f"no converged state: {diverged}"
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        trouble = f"{type(error).__name__}: {error} ({last.filename}:{last.lineno})"
    return Report(name, laws, time.perf_counter() - began, trouble)


def run_cases(
    cases: Sequence[Case],
    *,
    device: str = "cpu",
    mistake: str | None = None,
    processes: int = 2,
    say: Callable[[str], None] = print,
) -> list[Report]:
    """Run all cases, reporting each with the time left, and return the reports in order.

    After Ctrl-C, only completed cases are returned.
    """
    reports: dict[str, Report] = {}
    began = time.perf_counter()
    expected = {case.name: case.seconds for case in cases}
    with done_counts(say):
        for report in _done(cases, device, mistake, processes):
            reports[report.name] = report
            spent = sum(expected[name] for name in reports)
            left = sum(expected.values()) - spent
            elapsed = time.perf_counter() - began
            say(_line(report, len(reports), len(cases), left * elapsed / spent))
            for failure in report.failures:
                say(f"      {report.name}: {failure}")
    return [reports[case.name] for case in cases if case.name in reports]


def _done(
    cases: Sequence[Case], device: str, mistake: str | None, processes: int
) -> Iterator[Report]:
    """Yield reports as cases complete; the longest start first, so that none is left at the end."""
    order = sorted(cases, key=lambda case: -case.seconds)
    names = [case.name for case in order]
    return side_by_side(partial(_run_case, device, mistake), names, device, processes)


def _run_case(device: str, mistake: str | None, name: str) -> Report:
    return run_case(name, device, mistake)


def side_by_side(
    run: Callable[[Item], Outcome], items: Iterable[Item], device: str, processes: int
) -> Iterator[Outcome]:
    """Yield results as they complete, from several processes; items start in their order."""
    if processes == 1:
        yield from map(run, items)
        return
    with Workers(processes, _begin, device) as workers:
        for task in as_completed([workers.submit(run, item) for item in items]):
            yield task.result()


# Exit code of a run ended by Ctrl-C, as usual.
INTERRUPTED = 130


@contextmanager
def done_counts(say: Callable[[str], None]) -> Iterator[None]:
    """End the block on Ctrl-C, so that completed results are kept and reported."""
    try:
        yield
    except KeyboardInterrupt:
        say("interrupted; only completed results follow")


def _begin(device: str) -> None:
    """Start Warp in a new process without its banner."""
    from sim.device import ready_device

    ready_device(device)
    sys.stdout.flush()


def _line(report: Report, done: int, count: int, left: float) -> str:
    status = "passed" if report.passed else "FAILED"
    text = f"[{done:{len(str(count))}}/{count}] {status} {report.name:<38} {report.seconds:6.1f} s"
    return text if done == count else f"{text}   {duration(left)} left"
