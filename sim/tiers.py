"""Solution of scenes by one tier, `layer`, `fem` or `mpm`, in one launch or in many processes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, as_completed
from typing import TYPE_CHECKING, Literal

from sim.error_estimate import with_estimate
from sim.errors import SceneError, SimulationDiverged, check_kind
from sim.result import Outcome, Result
from sim.scene import Scene

if TYPE_CHECKING:
    from sim.fem.numerics import Numerics
    from sim.mpm import MpmNumerics

Tier = Literal["layer", "fem", "mpm"]
# `layer` is linear and takes milliseconds, `fem` is exact and takes seconds to minutes; `mpm` is
# the paper's method, costlier and less exact than `fem`, for comparison and for waves.
TIERS: tuple[Tier, ...] = ("layer", "fem", "mpm")


def simulate_one(
    scene: Scene,
    tier: Tier = "fem",
    *,
    numerics: Numerics | MpmNumerics | None = None,
    device: str = "cpu",
    progress: Callable[[float], None] | None = None,
) -> Result:
    """Solve one scene by one tier; arguments as in `simulate`.

    Raises:
        SceneError: The tier does not exist, or does not support the scene.
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
    """Simulate scenes in a batch; return a result for each, or the reason for none.

    `fem` and `mpm` solve sufficiently similar scenes in one launch. Arguments as in `simulate`, and
    `processes`: number of worker processes that share the scenes on a CPU. A script that requests
    several must do so under `if __name__ == "__main__":`.

    Raises:
        SceneError: As in `simulate`; processes below 1, or several on a GPU.
        WorkerLost: One of several processes was killed, by a lack of memory for example.
    """
    outcomes = _by_tier(
        scenes, tier, numerics=numerics, device=device, processes=processes, progress=progress
    )
    return [with_estimate(one) if isinstance(one, Result) else one for one in outcomes]


def _by_tier(
    scenes: Sequence[Scene],
    tier: Tier,
    *,
    numerics: Numerics | MpmNumerics | None,
    device: str,
    processes: int,
    progress: Callable[[float], None] | None,
) -> list[Outcome]:
    if tier not in TIERS:
        raise SceneError(f"tier: {tier!r}; allowed: {', '.join(TIERS)}")
    for scene in scenes:
        check_kind("scene", scene, Scene, "a Scene")
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


# Advice if a worker was killed for lack of memory.
FEWER = "fewer processes or a coarser mesh"


def check_processes(processes: int, device: str) -> None:
    """Reject an invalid number of processes.

    Raises:
        SceneError: Not a whole number from 1 up; or several if the device is not the CPU.
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
    """Return the outcomes of scenes in order, each solved alone on the CPU by one of the processes.

    Workers start as new interpreters and import the calling script, whose own work must therefore
    be under `if __name__ == "__main__":`. Two that compile the same kernels at once both do the
    work: Warp builds in a folder of each process and moves it into its cache atomically.

    Args:
        scenes: Scenes to simulate.
        tier: As in `simulate_many`.
        numerics: As in `simulate_many`.
        processes: Largest number of processes.
        progress: Called with the share of the scenes that are done.

    Raises:
        SceneError: As in `simulate_many`, the other scenes are abandoned; or meshes have to agree
            with those of other processes.
        WorkerLost: A worker was killed, by a lack of memory for example, or could not start.
    """
    if getattr(numerics, "one_topology", False):
        raise SceneError(
            f"numerics.one_topology: True with {processes} processes, which solve scenes one by "
            "one; allowed: False"
        )
    from recorder.processes import Workers  # hundreds of modules, not needed by one process

    workers = Workers(min(processes, len(scenes)), _make_ready, tier, fewer=FEWER)
    workers.done = f"0 of {len(scenes)} scenes"
    with workers:
        tasks = [workers.submit(_solve, scene, tier, numerics) for scene in scenes]
        for done, task in enumerate(as_completed(tasks), 1):
            _raise_error_of(task)
            workers.done = f"{done} of {len(scenes)} scenes"
            if progress is not None:
                progress(done / len(scenes))
        return [task.result() for task in tasks]


def _make_ready(tier: Tier) -> None:
    """Start Warp in a worker without a banner."""
    if tier != "layer":
        from sim.device import ready_device

        ready_device("cpu")


def _solve(scene: Scene, tier: Tier, numerics: Numerics | MpmNumerics | None) -> Outcome:
    return simulate_many([scene], tier, numerics=numerics)[0]


def _raise_error_of(task: Future[Outcome]) -> None:
    error = task.exception()
    if error is not None:
        raise error


def unfit(numerics: Numerics | MpmNumerics, tier: Tier, allowed: str) -> SceneError:
    """Return the error for numerics that belong to another tier."""
    return SceneError(f"numerics: {numerics!r}; allowed with tier {tier!r}: {allowed}")


def part_of(progress: Callable[[float], None], index: int, count: int) -> Callable[[float], None]:
    """Return a callback that converts the share of part `index` of `count` to that of the whole."""
    return lambda share: progress((index + share) / count)
