"""Run hard cases in several parallel processes, and judge them by their laws alone."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

from benchmarks.hard_cases.case import Case, Solver
from benchmarks.hard_cases.cases import BY_NAME
from benchmarks.hard_cases.laws import Law
from benchmarks.hard_cases.planted import planted
from benchmarks.processes import done_counts, side_by_side
from recorder.progress import duration
from sim.errors import SimulationDiverged


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


def _line(report: Report, done: int, count: int, left: float) -> str:
    status = "passed" if report.passed else "FAILED"
    text = f"[{done:{len(str(count))}}/{count}] {status} {report.name:<38} {report.seconds:6.1f} s"
    return text if done == count else f"{text}   {duration(left)} left"
