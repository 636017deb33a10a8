"""Work of a benchmark on several processes of one machine."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import as_completed
from contextlib import contextmanager
from typing import TypeVar

from recorder.processes import Workers

Item = TypeVar("Item")
Outcome = TypeVar("Outcome")


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
