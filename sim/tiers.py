"""Solution of scenes by one tier, `layer`, `fem` or `mpm`, in one launch or in many processes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, as_completed
from typing import TYPE_CHECKING

from recorder.progress import part_of
from sim.error_estimate import with_estimate
from sim.errors import SceneError, SimulationDiverged, check_kind
from sim.fem.numerics import Fem
from sim.layer.numerics import Layer
from sim.mpm.numerics import Mpm
from sim.result import Outcome, Result
from sim.scene import Scene

if TYPE_CHECKING:
    from sim.fem.mesh import Mesh

# `layer` is linear and takes milliseconds, `fem` is exact and takes seconds to minutes; `mpm` is
# the paper's method, costlier and less exact than `fem`, for comparison and for waves.
Tier = Layer | Fem | Mpm


def simulate_one(
    scene: Scene,
    tier: Tier = Fem(),
    *,
    device: str = "cpu",
    progress: Callable[[float], None] | None = None,
) -> Result:
    """Solve one scene by one tier; arguments as in `simulate`.

    Raises:
        SceneError: The tier does not support the scene.
        SimulationDiverged: No converged state was found.
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
    processes: int = 1,
    progress: Callable[[float], None] | None = None,
) -> list[Outcome]:
    """Simulate scenes in a batch; return a result for each, or the reason for none.

    On a GPU `layer` solves scenes of the same body together; `fem` and `mpm` solve sufficiently
    similar scenes in one launch. Arguments as in `simulate`, and
    `processes`: number of worker processes that share the scenes on a CPU. A script that requests
    several must do so under `if __name__ == "__main__":`.

    Raises:
        SceneError: As in `simulate`; processes below 1, or several on a GPU.
        WorkerLost: One of several processes was killed, by a lack of memory for example.
    """
    outcomes = _by_tier(scenes, tier, device, processes, progress)
    return [with_estimate(one) if isinstance(one, Result) else one for one in outcomes]


def _by_tier(
    scenes: Sequence[Scene],
    tier: Tier,
    device: str,
    processes: int,
    progress: Callable[[float], None] | None,
) -> list[Outcome]:
    check_kind("tier", tier, Tier, "a Layer, a Fem or an Mpm")
    for scene in scenes:
        check_kind("scene", scene, Scene, "a Scene")
    check_processes(processes, device)
    if processes > 1 and len(scenes) > 1:
        return simulate_in_processes(scenes, tier, processes=processes, progress=progress)
    if not scenes:
        return []
    if isinstance(tier, Layer):
        if device != "cpu":
            from sim.layer.batch import simulate_layers

            return simulate_layers(scenes, tier, device=device, progress=progress)
        from sim.layer.solver import simulate_layer

        outcomes: list[Outcome] = []
        for index, scene in enumerate(scenes):
            fraction = None
            if progress is not None:
                fraction = part_of(progress, index, len(scenes))
            try:
                outcomes.append(simulate_layer(scene, tier, progress=fraction))
            except SimulationDiverged as diverged:
                outcomes.append(diverged)
        return outcomes
    if isinstance(tier, Mpm):
        from sim.mpm.solver import simulate_mpm

        return simulate_mpm(scenes, tier, device=device, progress=progress)
    from sim.fem.solver import simulate_fem

    return simulate_fem(scenes, tier, device=device, progress=progress)


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
        processes: Largest number of processes.
        progress: Called with the fraction of the scenes that are done.

    Raises:
        SceneError: As in `simulate_many`, the other scenes are abandoned; or meshes have to agree
            with those of other processes.
        WorkerLost: A worker was killed, by a lack of memory for example, or could not start.
    """
    if isinstance(tier, Fem) and tier.one_topology:
        raise SceneError(
            f"fem.one_topology: True with {processes} processes, which solve scenes one by "
            "one; allowed: False"
        )
    from recorder.processes import Workers  # hundreds of modules, not needed by one process

    workers = Workers(min(processes, len(scenes)), _make_ready, tier, fewer=FEWER)
    workers.done = f"0 of {len(scenes)} scenes"
    with workers:
        tasks = [workers.submit(_solve, scene, tier) for scene in scenes]
        for done, task in enumerate(as_completed(tasks), 1):
            _raise_error_of(task)
            workers.done = f"{done} of {len(scenes)} scenes"
            if progress is not None:
                progress(done / len(scenes))
        return [task.result() for task in tasks]


def _make_ready(tier: Tier) -> None:
    """Start Warp in a worker without a banner."""
    if not isinstance(tier, Layer):
        from sim.device import ready_device

        ready_device("cpu")


def _solve(scene: Scene, tier: Tier) -> Outcome:
    return simulate_many([scene], tier)[0]


def _raise_error_of(task: Future[Outcome]) -> None:
    error = task.exception()
    if error is not None:
        raise error


# CPU time of a press by `layer`, and of each of its frames [s].
SECONDS_LAYER, SECONDS_LAYER_FRAME = 0.2, 0.015
# CPU time per element and Newton iteration [s], and iterations per step. 20 presses with friction
# took 5 to 20 iterations, and 5 to 10 us per element.
SECONDS_ITERATION, ITERATIONS = 6e-6, 8


def seconds_of(scene: Scene, tier: Layer | Fem, mesh: Mesh | None = None) -> float:
    """Return the approximate CPU time of one scene [s]; most take one to six times as long.

    Args:
        scene: Scene to simulate.
        tier: Tier and its settings.
        mesh: Mesh of `Fem`, if it is already built.
    """
    if isinstance(tier, Layer):
        return SECONDS_LAYER + SECONDS_LAYER_FRAME * len(scene.motion)
    from sim.fem.mesh import meshes_of
    from sim.fem.newton import path_of

    mesh = meshes_of([scene], tier)[0] if mesh is None else mesh
    path = path_of(scene, tier, *([mesh.finest] if tier.follows else []))
    return SECONDS_ITERATION * len(mesh.elements) * ITERATIONS * path.steps
