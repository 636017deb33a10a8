"""Worker processes on one machine: start, stop, and detection of lost workers."""

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any, ParamSpec, Self, TypeVar

from recorder.command_line.errors import CommandError

Parameters = ParamSpec("Parameters")
Answer = TypeVar("Answer")


class WorkerLost(CommandError, RuntimeError):
    """A worker process ended without a result; the state of its current call is unknown."""

    label = "cannot continue"


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Workers:
    """Context manager for a pool of worker processes.

    Processes are spawned when there is work, not forked, because torch's threads, Warp and GPU
    contexts do not survive a fork. Each has as many threads as its part of the cores, unless
    `OMP_NUM_THREADS` is set. They end with this process, however it ends. Workers never see
    Ctrl-C: an error or Ctrl-C that leaves the block stops them at once.
    """

    def __init__(
        self,
        processes: int,
        begin: Callable[..., object] | None = None,
        *arguments: Any,
        fewer: str = "fewer processes",
    ) -> None:
        """Prepare the pool; no process is started yet.

        Each worker calls `begin` with `arguments` before its first call. `fewer` is the remedy to
        suggest if a worker was killed for lack of memory.
        """
        self.processes = processes
        self._context, self._fewer = _Spawning(), fewer
        self._threads = str(max(1, cores() // processes))
        self._executor = ProcessPoolExecutor(processes, self._context, _begin, (begin, arguments))
        self.done = "0 calls"
        """Progress such as `3 of 9 scenes`, printed when a process is lost."""

    def submit(
        self,
        call: Callable[Parameters, Answer],
        *args: Parameters.args,
        **kwargs: Parameters.kwargs,
    ) -> Future[Answer]:
        """Schedule a call on the next free process."""
        own = "OMP_NUM_THREADS" in os.environ
        threads = {} if own else {"OMP_NUM_THREADS": self._threads}
        with environment(**threads), _interrupts_blocked():
            return self._executor.submit(call, *args, **kwargs)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, BrokenProcessPool):
            self._executor.shutdown(wait=True)
            raise WorkerLost(self._lost()) from error
        if error is not None:
            for worker in self._context.started:
                worker.terminate()
        self._executor.shutdown(wait=True, cancel_futures=True)

    def _lost(self) -> str:
        """Return the reason for the loss as far as exit codes show; other workers were stopped."""
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
            'starts processes must do so under if __name__ == "__main__":'
        )


def several(
    processes: int,
    begin: Callable[..., object] | None = None,
    *arguments: Any,
    fewer: str = "fewer processes",
) -> contextlib.AbstractContextManager[Workers | None]:
    """Return workers, or None in their place if one process is enough: this one."""
    if processes > 1:
        return Workers(processes, begin, *arguments, fewer=fewer)
    return contextlib.nullcontext()


def results(
    workers: Workers | None, call: Callable[..., Answer], due: Iterable[tuple[Any, ...]]
) -> Iterator[Answer]:
    """Yield `call(*arguments)` for each of `due`, in order, by workers or by this process."""
    if workers is None:
        yield from (call(*arguments) for arguments in due)
        return
    for task in [workers.submit(call, *arguments) for arguments in due]:
        yield task.result()


class _Spawning(SpawnContext):
    """Spawn context that records the processes it has started."""

    def __init__(self) -> None:
        super().__init__()
        self.started: list[SpawnProcess] = []

    def Process(self, *args: Any, **kwargs: Any) -> SpawnProcess:  # type: ignore[override] # noqa: N802
        """Return a process that can be stopped later."""
        process = SpawnProcess(*args, **kwargs)
        self.started.append(process)
        return process


@contextlib.contextmanager
def environment(**values: str) -> Iterator[None]:
    """Set environment variables for the processes and libraries that start inside."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextlib.contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Keep Ctrl-C from processes and threads started inside; their creator must stop them.

    They inherit the signal mask set here; a Ctrl-C in the meantime is delivered at the end.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(begin: Callable[..., object] | None, arguments: tuple[Any, ...]) -> None:
    """Make a worker end with its parent, then call `begin`."""
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()
    if begin is not None:
        begin(*arguments)


def _end_with_parent() -> None:
    """Wait for the parent to die, then exit: nothing else would stop this process."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
