"""Runs hard cases, several processes side by side, and judges them by their laws alone."""

from __future__ import annotations

import os
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
from sim.errors import SimulationDiverged
from sim.progress import duration

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


@dataclass(frozen=True, slots=True)
class Report:
    """What came of one case."""

    name: str
    laws: tuple[Law, ...]
    seconds: float
    """Time it took."""
    trouble: str = ""
    """Why there are no laws to judge: no converged state, or a crash."""

    @property
    def passed(self) -> bool:
        """Whether there are laws, and all hold."""
        return bool(self.laws) and not self.trouble and all(law.holds for law in self.laws)

    @property
    def failures(self) -> list[str]:
        """Each law that does not hold, or the trouble."""
        said = [self.trouble] if self.trouble else []
        said += [str(law) for law in self.laws if not law.holds]
        return said or ([] if self.laws else ["no law was measured"])


def run_case(name: str, device: str, mistake: str | None) -> Report:
    """Run one case here; whatever goes wrong in it is its failure, not the end of the others.

    A mistake is planted in this process, which may be a worker, and taken out when the case ends.
    """
    began = time.perf_counter()
    laws: tuple[Law, ...] = ()
    trouble = ""
    try:
        with planted(mistake):
            laws = tuple(BY_NAME[name].run(Solver(device)))
    except SimulationDiverged as diverged:
        trouble = f"no state was found: {diverged}"
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
    """Reports of all cases, in their order; each is told when it is done, with the time left.

    After Ctrl-C, of those that were done.
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
    """Reports as they come; the longest cases begin first, so that none is left at the end."""
    order = sorted(cases, key=lambda case: -case.seconds)
    names = [case.name for case in order]
    return side_by_side(partial(_run_case, device, mistake), names, device, processes)


def _run_case(device: str, mistake: str | None, name: str) -> Report:
    return run_case(name, device, mistake)


def side_by_side(
    run: Callable[[Item], Outcome], items: Iterable[Item], device: str, processes: int
) -> Iterator[Outcome]:
    """What `run` gives for each item, as they come, by several processes; begun in their order."""
    if processes == 1:
        yield from map(run, items)
        return
    # One thread a process: NumPy's own would compete with the other process for the cores.
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        with Workers(processes, _begin, device) as workers:
            for task in as_completed([workers.submit(run, item) for item in items]):
                yield task.result()
    finally:
        if before is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = before


# Exit code of a run that Ctrl-C ended, as of any program.
INTERRUPTED = 130


@contextmanager
def done_counts(say: Callable[[str], None]) -> Iterator[None]:
    """Ctrl-C ends the block and no more: what came out of it until then is kept and told."""
    try:
        yield
    except KeyboardInterrupt:
        say("interrupted; what follows is of those that were done")


def _begin(device: str) -> None:
    """Start Warp in a new process without its greeting."""
    from sim.device import ready_device

    ready_device(device)
    sys.stdout.flush()


def _line(report: Report, done: int, count: int, left: float) -> str:
    verdict = "passed" if report.passed else "FAILED"
    text = f"[{done:{len(str(count))}}/{count}] {verdict} {report.name:<38} {report.seconds:6.1f} s"
    return text if done == count else f"{text}   {duration(left)} left"
