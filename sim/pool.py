"""Many scenes on the cores of one machine: worker processes that take one scene after the other."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import TYPE_CHECKING, Any

from sim.errors import SceneError
from sim.result import Outcome
from sim.scene import Scene
from sim.simulate import Tier, simulate_many

if TYPE_CHECKING:
    from sim.fem.numerics import Numerics
    from sim.mpm import MpmNumerics


class WorkerLost(RuntimeError):
    """A worker process ended without an answer; nothing is known of the scene that it was at."""


def check_processes(processes: int, device: str) -> None:
    """Refuse a number of processes that cannot be.

    Raises:
        SceneError: Not a whole number from 1 up; or several where the device is not the CPU.
    """
    if not isinstance(processes, int) or isinstance(processes, bool) or processes < 1:
        raise SceneError(f"processes: {processes!r}; allowed: whole numbers from 1 up")
    if processes > 1 and device != "cpu":
        raise SceneError(
            f"processes: {processes} on device {device!r}, which solves scenes side by side in one "
            "process; allowed: 1, or device 'cpu'"
        )


def simulate_in_processes(
    scenes: Sequence[Scene],
    tier: Tier,
    *,
    numerics: Numerics | MpmNumerics | None,
    processes: int,
    progress: Callable[[float], None] | None = None,
) -> list[Outcome]:
    """Outcomes of scenes in their order, each solved alone on the CPU by one of the processes.

    Workers are started afresh and import the calling script, whose own work must therefore stand
    under `if __name__ == "__main__":`. Two that compile the same kernels at once both do the work:
    Warp builds in a folder of each process and moves it into its cache whole.

    Args:
        scenes: What is simulated.
        tier: As for `simulate_many`.
        numerics: As for `simulate_many`.
        processes: How many at most.
        progress: Called with the share of the scenes that are done.

    Raises:
        SceneError: As `simulate_many`, the other scenes are given up; or meshes that are to agree
            with those of other processes.
        WorkerLost: A worker was killed, by a lack of memory for example, or could not start.
    """
    if getattr(numerics, "one_topology", False):
        raise SceneError(
            f"numerics.one_topology: True with {processes} processes, which solve scenes one by "
            "one; allowed: False"
        )
    context = Spawning()
    executor = ProcessPoolExecutor(
        min(processes, len(scenes)), mp_context=context, initializer=make_ready, initargs=(tier,)
    )
    done = 0
    try:
        with interrupts_kept_off():
            tasks = [executor.submit(_solve, scene, tier, numerics) for scene in scenes]
        for task in as_completed(tasks):
            _raise_error_of(task)
            done += 1
            if progress is not None:
                progress(done / len(scenes))
        return [task.result() for task in tasks]
    except BrokenProcessPool as broken:
        executor.shutdown(wait=True)
        raise WorkerLost(
            lost_worker(context.started, f"{done} of {len(scenes)} scenes")
        ) from broken
    finally:
        if done < len(scenes):
            for worker in context.started:
                worker.terminate()
        executor.shutdown(wait=True, cancel_futures=True)


def _solve(scene: Scene, tier: Tier, numerics: Numerics | MpmNumerics | None) -> Outcome:
    return simulate_many([scene], tier, numerics=numerics)[0]


def make_ready(tier: Tier, device: str = "cpu") -> None:
    """Make a worker end with its parent, and start Warp without a banner of its own."""
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()
    if tier != "layer":
        from sim.verbs.device import ready_device

        ready_device(device)


def _end_with_parent() -> None:
    """Wait for the parent to die: nobody is left then to stop this process."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _raise_error_of(task: Future[Outcome]) -> None:
    error = task.exception()
    if error is not None:
        raise error


class Spawning(SpawnContext):
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
def interrupts_kept_off() -> Iterator[None]:
    """Processes and threads begun inside never see Ctrl-C: who began them stops them.

    They inherit what is blocked here; a Ctrl-C that comes meanwhile arrives at the end.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def lost_worker(workers: Sequence[SpawnProcess], done: str) -> str:
    """What became of the workers, as far as their exit codes tell; the others were stopped then.

    `done` is how much had been done, such as "3 of 9 scenes".
    """
    codes = [worker.exitcode or 0 for worker in workers]
    came = f"{done} done"
    for code in codes:
        if code < 0 and code != -signal.SIGTERM:
            reason = ", most likely for lack of memory" if code == -signal.SIGKILL else ""
            return (
                f"a worker process was killed by {signal.Signals(-code).name}{reason}, {came}; "
                "allowed: fewer processes or a coarser mesh"
            )
    return (
        f"a worker process ended with exit code {max(codes)}, {came}; a script that asks for "
        'processes has to do so under if __name__ == "__main__":'
    )
