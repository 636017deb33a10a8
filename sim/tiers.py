"""Solution of scenes by one tier, `layer`, `fem` or `mpm`, in one launch or in many processes."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Sequence
from concurrent.futures import Future, as_completed
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

from recorder.progress import part_of
from sim.arrays import Progress
from sim.error_estimate import estimated
from sim.errors import SceneError, SimulationDiverged, check_kind
from sim.fem import Fem
from sim.layer import Layer
from sim.result import Outcome, Result
from sim.scene import Scene

if TYPE_CHECKING:
    from recorder.processes import Workers
    from sim.mpm import Mpm

    # `layer` is linear and takes milliseconds, `fem` is exact and takes seconds to minutes; `mpm`
    # is the paper's method, costlier and less exact than `fem`, for comparison.
    Tier = Layer | Fem | Mpm


def simulate(
    scene: Scene, tier: Tier = Fem(), *, device: str = "cpu", progress: Progress | None = None
) -> Result:
    """Simulate one scene; see `sim.plan` for a tolerance in place of a tier.

    Args:
        scene: Scene to simulate.
        tier: Tier and its settings. `Layer`: spectral bonded layer, small strain, no free sides;
            `Fem`: finite elements, large strain; `Mpm`: explicit material points.
        device: `cpu` or `cuda:0` and the like.
        progress: Called with the fraction done, 0 to 1.

    Raises:
        SceneError: The tier does not support the scene.
        SimulationDiverged: No converged state was found; nothing unconverged is returned.
    """
    outcome = simulate_many([scene], tier, device=device, progress=progress)[0]
    if isinstance(outcome, SimulationDiverged):
        raise outcome
    return outcome


def simulate_many(
    scenes: Sequence[Scene],
    tier: Tier = Fem(),
    *,
    device: str = "cpu",
    processes: int | Workers = 1,
    progress: Progress | None = None,
) -> list[Outcome]:
    """Simulate scenes in a batch; return a result for each, or the reason for none.

    `fem` and `mpm`, and `layer` on a GPU, solve sufficiently similar scenes in one launch.
    Processes on a CPU solve one scene after the other; beside a GPU each solves a part of the
    scenes as one batch, so that the host's work for them, which takes more time than the GPU's, is
    spread over cores. Their kernels run at once if NVIDIA's Multi-Process Service is running
    (`nvidia-cuda-mps-control -d`), otherwise in turns.

    Args:
        scenes: Scenes to simulate.
        tier: As in `simulate`.
        device: As in `simulate`.
        processes: Number of worker processes, started for this call, among which the scenes are
            divided; or `recorder.processes.Workers` that are running, for several calls. They are
            new interpreters that import the calling script, whose own work must therefore be under
            `if __name__ == "__main__":`.
        progress: Called with the fraction done, 0 to 1.

    Raises:
        SceneError: As in `simulate`; or processes below 1.
        WorkerLost: One of several processes was killed, by a lack of memory for example.
    """
    outcomes = _by_tier(scenes, tier, device, processes, progress)
    return list(map(estimated, outcomes))


def _by_tier(
    scenes: Sequence[Scene],
    tier: Tier,
    device: str,
    processes: int | Workers,
    progress: Progress | None,
) -> list[Outcome]:
    if not isinstance(tier, Layer | Fem):
        from sim.mpm import Mpm

        check_kind("tier", tier, Mpm, "a Layer, a Fem or an Mpm")
    check_kind("scenes", scenes, Sequence, "a sequence of Scenes; `simulate` takes a single one")
    for scene in scenes:
        check_kind("scene", scene, Scene, "a Scene")
    pool = _pool(processes, len(scenes))
    if not scenes:
        return []
    if pool is not None:
        with pool as workers:
            return gathered(workers, submitted(workers, scenes, tier, device), progress)
    if isinstance(tier, Layer):
        if device != "cpu":
            from sim.layer.batch import simulate_layers

            return simulate_layers(scenes, tier, device=device, progress=progress)
        from sim.layer.solver import simulate_layer

        outcomes: list[Outcome] = []
        for index, scene in enumerate(scenes):
            fraction = None if progress is None else part_of(progress, index, len(scenes))
            try:
                outcomes.append(simulate_layer(scene, tier, progress=fraction))
            except SimulationDiverged as diverged:
                outcomes.append(diverged)
        return outcomes
    if isinstance(tier, Fem):
        from sim.fem.in_time import simulate_in_time

        return simulate_in_time(scenes, tier, device=device, progress=progress)
    from sim.mpm.solver import simulate_mpm

    return simulate_mpm(scenes, tier, device=device, progress=progress)


# Advice if a worker was killed for lack of memory.
FEWER = "fewer processes or a coarser mesh"


def _pool(processes: int | Workers, most: int) -> AbstractContextManager[Workers] | None:
    """Return the processes for `most` scenes; None: this one."""
    if type(processes) is int and processes == 1:
        return None  # without an import of hundreds of modules
    from recorder.processes import Workers

    if isinstance(processes, Workers):
        return contextlib.nullcontext(processes)
    if not isinstance(processes, int) or isinstance(processes, bool) or processes < 1:
        raise SceneError(f"processes: {processes!r}; allowed: whole numbers from 1 up")
    return Workers(min(processes, most), fewer=FEWER) if most > 1 else None


# Calls that solve, and the scenes of each.
Calls = dict[Future[list[Outcome]], range]


def submitted(workers: Workers, scenes: Sequence[Scene], tier: Tier, device: str) -> Calls:
    """Begin to solve scenes, as in `simulate_many`, and return the calls."""
    if device == "cpu" and isinstance(tier, Fem) and tier.one_topology:
        raise SceneError(
            f"fem.one_topology: True with {workers.processes} processes, which solve scenes one by "
            "one; allowed: False"
        )
    return {
        workers.submit(_solve, [scenes[one] for one in part], tier, device): part
        for part in _parts(len(scenes), tier, workers.processes, device)
    }


def gathered(workers: Workers, calls: Calls, progress: Progress | None = None) -> list[Outcome]:
    """Return the outcomes of calls, in the order of the scenes; arguments as in `simulate_many`."""
    count, done = sum(map(len, calls.values())), 0
    outcomes: dict[int, Outcome] = {}
    workers.done = f"0 of {count} scenes"
    for task in as_completed(calls):
        outcomes |= zip(calls[task], task.result(), strict=True)
        done += len(calls[task])
        workers.done = f"{done} of {count} scenes"
        if progress is not None:
            progress(done / count)
    return [outcomes[one] for one in range(count)]


def _parts(count: int, tier: Tier, processes: int, device: str) -> list[range]:
    """Return the scenes of each call: single ones on a CPU, where any process takes the next.

    Beside a GPU each process has a batch. Neighbours in the list are often alike: they take
    equally long, so they are dealt out in turns if all meshes have one topology; else they
    stay with each other, because they often have the same one, and are solved in one launch.
    """
    if device == "cpu":
        return [range(one, one + 1) for one in range(count)]
    parts = min(processes, count)
    if isinstance(tier, Fem) and not tier.one_topology:
        edges = [count * part // parts for part in range(parts + 1)]
        return [range(first, last) for first, last in itertools.pairwise(edges)]
    return [range(part, count, parts) for part in range(parts)]


def _solve(scenes: Sequence[Scene], tier: Tier, device: str) -> list[Outcome]:
    if device != "cpu" or not isinstance(tier, Layer):
        from sim.device import ready_device

        ready_device(device)  # Warp starts without a banner
    return simulate_many(scenes, tier, device=device)
