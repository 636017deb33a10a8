"""Units made on this machine: one after the other, or one a process at a time."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool

from sim.archives.beginning import Begun
from sim.archives.families import Unit
from sim.archives.making import Made, make_unit
from sim.archives.stopping import Stop
from sim.pool import Spawning, WorkerLost, interrupts_kept_off, lost_worker, make_ready

ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
"""What keeps a worker to one core, and its sums in one order."""


def make_here(
    begun: Begun,
    units: Sequence[Unit],
    inside: Callable[[float], None] | None = None,
    *,
    device: str,
    stop: Stop,
) -> Iterator[Made]:
    """Make units one by one in this process, as a GPU wants it.

    Args:
        begun: The archive.
        units: What is missing of it.
        inside: Called with the share of the unit's presses that are solved.
        device: Where.
        stop: Asked between units.

    Raises:
        SceneError, OSError: As `make_unit`.
    """
    for unit in units:
        if stop.asked:
            return
        yield make_unit(begun.path, begun.plan, unit, device, inside)


def make_in_processes(
    begun: Begun,
    units: Sequence[Unit],
    inside: object = None,
    *,
    processes: int,
    stop: Stop,
    device: str = "cpu",
) -> Iterator[Made]:
    """Make units in the order in which they are done; each process has one thread.

    Args:
        begun: The archive.
        units: What is missing of it.
        inside: Not called: several units are in hand.
        processes: How many at most.
        stop: Asked before each unit.
        device: Where images are made; presses too, but those of `layer`.

    Raises:
        SceneError, OSError: As `make_unit`; units in flight are given up.
        WorkerLost: A process was killed, by a lack of memory for example.
    """
    context = Spawning()
    rest = iter(units)
    pending: set[Future[Made]] = set()
    executor = ProcessPoolExecutor(
        max(1, min(processes, len(units))),
        mp_context=context,
        initializer=make_ready,
        initargs=("fem", device),  # images are made by Warp, whatever the tier
    )
    done = 0
    finished = False
    try:
        while True:
            # No more than are worked on, so that a stop is one.
            while len(pending) < processes and not stop.asked:
                unit = next(rest, None)
                if unit is None:
                    break
                with _one_thread(), interrupts_kept_off():
                    pending.add(executor.submit(make_unit, begun.path, begun.plan, unit, device))
            if not pending:
                finished = True
                return
            ready, pending = wait(pending, return_when=FIRST_COMPLETED)
            for task in ready:
                yield task.result()
                done += 1
    except BrokenProcessPool as broken:
        executor.shutdown(wait=True)
        raise WorkerLost(lost_worker(context.started, f"{done} of {len(units)} units")) from broken
    finally:
        if not finished:
            for worker in context.started:
                worker.terminate()
        executor.shutdown(wait=True, cancel_futures=True)


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Processes that are started inside have one thread for sums of matrices."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
