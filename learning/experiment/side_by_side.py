"""Pieces of an experiment, one after the other or several at once.

A small network keeps a GPU busy for a part of the time only: the rest goes into telling it what to
do. Several processes fill it.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Mapping, Set
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait

import torch

from learning.errors import LearningError
from learning.experiment.worker import Done, Piece, Work, Worker

Say = Callable[[str], None]


def do_all(work: Work, jobs: int, say: Say) -> list[Done]:
    """Return what all pieces give, each done after those that it needs.

    Args:
        work: What is to be done.
        jobs: How many pieces at once, each in a process of its own; 1: all in this one.
        say: Called with a line for each thing that was done.

    Raises:
        LearningError: A piece that cannot be done, or for which there is no memory beside the
            others; pieces that run meanwhile end first.
        SessionError: A damaged archive.
        KeyboardInterrupt: It was stopped; what trains saves where it is.
    """
    if jobs == 1:
        worker = Worker(work, say)
        return [worker.do(piece) for piece in work.pieces]
    context = multiprocessing.get_context("spawn")  # a GPU does not survive a fork
    pool = ProcessPoolExecutor(jobs, context, _begin, (work,))
    try:
        return _done(pool, work.pieces, say)
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
    except torch.OutOfMemoryError as error:
        raise LearningError(
            f"jobs: found no memory left on the device for {' '.join(piece)} beside the others; "
            "allowed: fewer jobs (the same command goes on)"
        ) from error
    return done, [*_said]


def _done(pool: Executor, pieces: Mapping[Piece, Set[Piece]], say: Say) -> list[Done]:
    """Return what pieces give, in their order; each begins when all it needs is done."""
    due, found = dict(pieces), dict[Piece, Done]()
    running: dict[Future[tuple[Done, list[str]]], Piece] = {}
    while due or running:
        for piece in [piece for piece, needed in due.items() if needed <= found.keys()]:
            del due[piece]
            running[pool.submit(_do, piece)] = piece
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            done, said = future.result()
            for line in said:
                say(line)
            found[running.pop(future)] = done
    return [found[piece] for piece in pieces]
