"""Work of a benchmark on several processes of one machine."""

import argparse
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from contextlib import contextmanager, suppress
from functools import partial
from types import FrameType
from typing import Any, TypeVar

from benchmarks.report import Run
from recorder.command_line.options import whole
from recorder.processes import Workers

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")
# Time after which work that ignored its time limit is called out again [s].
AGAIN = 5.0
# Time in which a process of its own must answer [s].
_ANSWER = 300.0


class OutOfTime(Exception):
    """Raised if work takes too long."""


class ChildFailed(RuntimeError):
    """Raised if a process did not answer, with its error."""


def add_processes(parser: argparse.ArgumentParser, default: int = 1) -> None:
    """Add `--processes`."""
    parser.add_argument(
        "--processes",
        type=whole(1, 256),
        default=default,
        metavar="N",
        help="processes among which the work is divided (%(default)s)",
    )


def _side_by_side(
    run: Callable[[Item], Outcome], items: Sequence[Item], device: str, processes: int
) -> Iterator[Outcome]:
    """Yield results as they complete, from several processes; items start in their order."""
    processes = min(processes, len(items))
    if processes <= 1:
        yield from map(run, items)
        return
    with Workers(processes, _begin, device) as workers:
        for task in as_completed([workers.submit(run, item) for item in items]):
            yield task.result()


def alone(work: Callable[..., Outcome], *arguments: object) -> Outcome:
    """Return what `work` returns in a process of its own; ChildFailed if that gave no answer."""
    try:
        with Workers(1) as worker:
            return worker.submit(work, *arguments).result(_ANSWER)
    except ImportError as error:
        raise ChildFailed(f"{error.name or error} is not installed") from None
    except Exception as error:
        raise ChildFailed(f"{type(error).__name__}: {error}"[:160]) from error


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise `OutOfTime` in the main thread if the block takes longer."""

    def ring(_number: int, _frame: FrameType | None) -> None:
        raise OutOfTime(f"no answer within {seconds:g} s")

    before = signal.signal(signal.SIGALRM, ring)
    # Again and again: an exception within a destructor is ignored.
    signal.setitimer(signal.ITIMER_REAL, seconds, AGAIN)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def rows_of(
    run: Run,
    work: Callable[[Item], Any],
    items: Mapping[str, Item],
    progress: Callable[[float], None] | None = None,
) -> dict[str, Any]:
    """Return the row, in JSON, that `work` returns of each item, by `--processes` processes.

    Rows are stored as they complete, as those of `Run.once`; those that an interrupted run has
    stored are not made again. The rows returned are in the order of `items`, in which they also
    start. Names of items differ from those of all other rows of the part. `progress` is called with
    the fraction done; without it, that of the run is.
    """
    progress = progress or run.progress
    left = [(name, item) for name, item in items.items() if name not in run.rows]
    done = len(items) - len(left)
    for name, row in _side_by_side(partial(_named, work), left, run.device, run.options.processes):
        run.rows[name] = row
        run.store()
        done += 1
        progress(done / len(items))
    return {name: run.rows[name] for name in items}


def _named(work: Callable[[Item], Outcome], named: tuple[str, Item]) -> tuple[str, Outcome]:
    name, item = named
    return name, work(item)


def _begin(device: str) -> None:
    """Start Warp in a new process without its banner, if it is installed."""
    from sim.device import ready_device

    with suppress(ModuleNotFoundError):
        ready_device(device)
    sys.stdout.flush()
