"""Scenes solved by one tier: `layer`, `fem` or `mpm`, in one launch or by many processes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import TYPE_CHECKING, Literal

from sim.errors import SceneError, SimulationDiverged
from sim.pool import (
    Spawning,
    WorkerLost,
    check_processes,
    interrupts_kept_off,
    lost_worker,
    make_ready,
)
from sim.result import Outcome, Result
from sim.scene import Scene

if TYPE_CHECKING:
    from sim.fem.numerics import Numerics
    from sim.mpm import MpmNumerics

Tier = Literal["layer", "fem", "mpm"]
TIERS: tuple[Tier, ...] = ("layer", "fem", "mpm")
"""`layer` is linear and takes milliseconds, `fem` is exact and takes seconds to minutes; `mpm` is
the paper's method, dearer and less exact than `fem`, to compare with and to see waves."""


def simulate_one(
    scene: Scene,
    tier: Tier = "fem",
    *,
    numerics: Numerics | MpmNumerics | None = None,
    device: str = "cpu",
    progress: Callable[[float], None] | None = None,
) -> Result:
    """Solve one scene by one tier; arguments as for `simulate`.

    Raises:
        SceneError: A tier that is not there, or that does not know what the scene asks for.
        SimulationDiverged: No converged state was found.
    """
    outcome = simulate_many([scene], tier, numerics=numerics, device=device, progress=progress)[0]
    if isinstance(outcome, SimulationDiverged):
        raise outcome
    return outcome


def simulate_many(
    scenes: Sequence[Scene],
    tier: Tier = "fem",
    *,
    numerics: Numerics | MpmNumerics | None = None,
    device: str = "cpu",
    processes: int = 1,
    progress: Callable[[float], None] | None = None,
) -> list[Outcome]:
    """Simulate scenes side by side; each gives its result, or the reason why there is none.

    `fem` and `mpm` solve them together in one launch where they are alike enough. Arguments as for
    `simulate`, and `processes`: how many worker processes share the scenes on a CPU; a script that
    asks for several does so under `if __name__ == "__main__":`.

    Raises:
        SceneError: As `simulate`; processes below 1, or several on a GPU.
        WorkerLost: One of several processes was killed, by a lack of memory for example.
    """
    if tier not in TIERS:
        raise SceneError(f"tier: {tier!r}; allowed: {', '.join(TIERS)}")
    check_processes(processes, device)
    if processes > 1 and len(scenes) > 1:
        return simulate_in_processes(
            scenes, tier, numerics=numerics, processes=processes, progress=progress
        )
    if not scenes:
        return []
    if tier == "layer":
        if numerics is not None:
            raise unfit(numerics, tier, "None")
        from sim.layer import simulate_layer

        outcomes: list[Outcome] = []
        for index, scene in enumerate(scenes):
            share = None
            if progress is not None:
                share = part_of(progress, index, len(scenes))
            try:
                outcomes.append(simulate_layer(scene, progress=share))
            except SimulationDiverged as diverged:
                outcomes.append(diverged)
        return outcomes
    if tier == "mpm":
        from sim.mpm import MpmNumerics, simulate_mpm

        if numerics is not None and not isinstance(numerics, MpmNumerics):
            raise unfit(numerics, tier, "MpmNumerics")
        return simulate_mpm(scenes, numerics, device=device, progress=progress)
    from sim.fem.numerics import Numerics
    from sim.fem.solver import simulate_fem

    if numerics is not None and not isinstance(numerics, Numerics):
        raise unfit(numerics, tier, "Numerics")
    return simulate_fem(scenes, numerics, device=device, progress=progress)


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


def _raise_error_of(task: Future[Outcome]) -> None:
    error = task.exception()
    if error is not None:
        raise error


def unfit(numerics: Numerics | MpmNumerics, tier: Tier, allowed: str) -> SceneError:
    """The error of numerics that belong to another tier."""
    return SceneError(f"numerics: {type(numerics).__name__}; allowed with tier {tier!r}: {allowed}")


def part_of(progress: Callable[[float], None], index: int, count: int) -> Callable[[float], None]:
    """What tells of the share of part `index` of `count` as a share of the whole."""
    return lambda share: progress((index + share) / count)
