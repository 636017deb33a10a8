"""Worker processes on the cores of one machine: how they start, end and are missed."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.context import SpawnContext, SpawnProcess
from types import TracebackType
from typing import Any, ParamSpec, Self, TypeVar

Given = ParamSpec("Given")
Answer = TypeVar("Answer")


class WorkerLost(RuntimeError):
    """A worker process ended without an answer; nothing is known of the work that it was at."""


class Workers:
    """Some processes that do calls for this one: a context manager.

    They are started anew, as neither threads of torch nor Warp nor a GPU survive a fork, when there
    is work for them, and end with this process, however it ends. They never see Ctrl-C: an error or
    Ctrl-C that leaves the block stops them at once. `patient` ones see it themselves, and end the
    calls that they are at before the block is left.
    """

    def __init__(
        self,
        processes: int,
        begin: Callable[..., object] | None = None,
        *arguments: Any,
        patient: bool = False,
        fewer: str = "fewer processes",
    ) -> None:
        """Prepare processes; none is started yet.

        Args:
            processes: How many at most.
            begin: Called by each before its first call.
            arguments: Of `begin`.
            patient: Whether calls that are begun are always ended.
            fewer: What is allowed where one was killed for lack of memory.
        """
        self._context, self._patient, self._fewer = _Spawning(), patient, fewer
        self._executor = ProcessPoolExecutor(processes, self._context, _begin, (begin, arguments))
        self.done = "0 calls"
        """How much is done, such as `3 of 9 scenes`: told when a process is lost."""

    def submit(
        self, call: Callable[Given, Answer], *args: Given.args, **kwargs: Given.kwargs
    ) -> Future[Answer]:
        """Have a call done by the next process that is free."""
        with contextlib.nullcontext() if self._patient else _interrupts_kept_off():
            return self._executor.submit(call, *args, **kwargs)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if isinstance(error, BrokenProcessPool):
            self._executor.shutdown(wait=True)
            raise WorkerLost(self._lost()) from error
        if error is not None and not self._patient:
            for worker in self._context.started:
                worker.terminate()
        self._executor.shutdown(wait=True, cancel_futures=True)

    def _lost(self) -> str:
        """What became of the workers, as far as their exit codes tell; the others were stopped."""
        codes = [worker.exitcode or 0 for worker in self._context.started]
        for code in codes:
            if code < 0 and code != -signal.SIGTERM:
                reason = ", most likely for lack of memory" if code == -signal.SIGKILL else ""
                return (
                    f"a worker process was killed by {signal.Signals(-code).name}{reason}, "
                    f"{self.done} done; allowed: {self._fewer}"
                )
        return (
            f"a worker process ended with exit code {max(codes)}, {self.done} done; a script that "
            'asks for processes has to do so under if __name__ == "__main__":'
        )


class _Spawning(SpawnContext):
    """Starts processes anew, and knows those that it has started."""

    def __init__(self) -> None:
        super().__init__()
        self.started: list[SpawnProcess] = []

    def Process(self, *args: Any, **kwargs: Any) -> SpawnProcess:  # type: ignore[override] # noqa: N802
        """A process that can be stopped later."""
        process = SpawnProcess(*args, **kwargs)
        self.started.append(process)
        return process


@contextlib.contextmanager
def _interrupts_kept_off() -> Iterator[None]:
    """Processes and threads begun inside never see Ctrl-C: who began them stops them.

    They inherit what is blocked here; a Ctrl-C that comes meanwhile arrives at the end.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(begin: Callable[..., object] | None, arguments: tuple[Any, ...]) -> None:
    """Make a worker end with its parent, then begin."""
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()
    if begin is not None:
        begin(*arguments)


def _end_with_parent() -> None:
    """Wait for the parent to die: nobody is left then to stop this process."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
