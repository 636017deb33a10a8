"""Pieces of an experiment, one after the other or several at once.

A small network keeps a GPU busy for a part of the time only: the rest goes into telling it what to
do. Several processes fill it.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor

from learning.experiment.worker import Done, Work, Worker

Say = Callable[[str], None]
Piece = tuple[str, ...]


def do_all(work: Work, jobs: int, say: Say) -> list[Done]:
    """Return what all pieces give, the first and then those that need them.

    Args:
        work: What is to be done.
        jobs: How many pieces at once, each in a process of its own; 1: all in this one.
        say: Called with a line for each thing that was done.

    Raises:
        LearningError: A piece that cannot be done; pieces that run meanwhile end first.
        SessionError: A damaged archive.
        KeyboardInterrupt: It was stopped; what trains saves where it is.
    """
    if jobs == 1:
        worker = Worker(work, say)
        return [worker.do(piece) for piece in (*work.first, *work.second)]
    context = multiprocessing.get_context("spawn")  # a GPU does not survive a fork
    pool = ProcessPoolExecutor(jobs, context, _begin, (work,))
    try:
        return [*_done(pool, work.first, say), *_done(pool, work.second, say)]
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


_worker: Worker | None = None
"""Of a process of the pool."""
_said: list[str] = []
"""Lines since the last piece was done."""
_stopped = False
"""Ctrl-C came: pieces that this process was already given are not begun."""


def _begin(work: Work) -> None:
    global _worker
    _worker = Worker(work, _said.append)


def _do(piece: Piece) -> tuple[Done, list[str]]:
    global _stopped
    if _worker is None:
        raise RuntimeError("the pool has not begun")
    if _stopped:
        raise KeyboardInterrupt
    _said.clear()
    try:
        done = _worker.do(piece)
    except KeyboardInterrupt:
        _stopped = True
        raise
    return done, [*_said]


def _done(pool: ProcessPoolExecutor, pieces: Sequence[Piece], say: Say) -> list[Done]:
    """Return what pieces give, in their order."""
    waiting: list[Future[tuple[Done, list[str]]]] = [pool.submit(_do, piece) for piece in pieces]
    found = []
    for future in waiting:
        done, said = future.result()
        for line in said:
            say(line)
        found.append(done)
    return found
