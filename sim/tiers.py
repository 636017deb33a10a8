"""Solution of scenes by one tier, `layer`, `fem` or `mpm`, in one launch or in many processes."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, as_completed
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

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
# the paper's method, costlier and less exact than `fem`, for comparison.
Tier = Layer | Fem | Mpm


def simulate_one(
    scene: Scene,
    tier: Tier = Fem(),
    *,
    device: str = "cpu",
    progress: Callable[[float], None] | None = None,
) -> Result:
    """Solve one scene by one tier; arguments as in `simulate`."""
    outcome = simulate_many([scene], tier, device=device, progress=progress)[0]
    if isinstance(outcome, SimulationDiverged):
        raise outcome
    return outcome


def simulate_many(
    scenes: Sequence[Scene],
    tier: Tier = Fem(),
    *,
    device: str = "cpu",
    processes: int | Solvers = 1,
    progress: Callable[[float], None] | None = None,
) -> list[Outcome]:
    """Simulate scenes in a batch; return a result for each, or the reason for none.

    `fem` and `mpm`, and `layer` on a GPU, solve sufficiently similar scenes in one launch.

    Args:
        scenes: Scenes to simulate.
        tier: As in `simulate`.
        device: As in `simulate`.
        processes: Number of worker processes, started for this call, among which the scenes are
            divided; or `Solvers` that are running. A script that requests several must do so under
            `if __name__ == "__main__":`.
        progress: Called with the fraction done, 0 to 1.

    Raises:
        SceneError: As in `simulate`; processes below 1, or of another device.
        WorkerLost: One of several processes was killed, by a lack of memory for example.
    """
    outcomes = _by_tier(scenes, tier, device, processes, progress)
    return [with_estimate(one) if isinstance(one, Result) else one for one in outcomes]


def _by_tier(
    scenes: Sequence[Scene],
    tier: Tier,
    device: str,
    processes: int | Solvers,
    progress: Callable[[float], None] | None,
) -> list[Outcome]:
    check_kind("tier", tier, Tier, "a Layer, a Fem or an Mpm")
    for scene in scenes:
        check_kind("scene", scene, Scene, "a Scene")
    if not isinstance(processes, Solvers):
        check_processes(processes)
    if not scenes:
        return []
    if isinstance(processes, Solvers) or (processes > 1 and len(scenes) > 1):
        with running(processes, device, len(scenes)) as solvers:
            return solvers.simulate(scenes, [tier], progress)[0]
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


class Solvers:
    """Context manager for processes that solve scenes, for several calls of `simulate_many`.

        with Solvers(8, device="cuda:0") as solvers:
            outcomes = simulate_many(scenes, Fem(), device="cuda:0", processes=solvers)

    On a CPU a process solves one scene after the other. Beside a GPU each solves a part of the
    scenes as one batch: so the host's work for them, which takes more time than the GPU's, is
    spread over cores. Their kernels run at once if NVIDIA's Multi-Process Service is running
    (`nvidia-cuda-mps-control -d`), otherwise in turns.

    Processes start with the first scenes, as new interpreters that import the calling script, whose
    own work must therefore be under `if __name__ == "__main__":`. Two that compile the same kernels
    at once both do the work: Warp builds in a folder of each process and moves it into its cache
    atomically.
    """

    def __init__(self, processes: int, *, device: str = "cpu") -> None:
        """Prepare the processes.

        Args:
            processes: Largest number of processes.
            device: Device of all of them, `cpu` or `cuda:0` and the like.
        """
        from recorder.processes import Workers  # hundreds of modules, not needed by one process

        check_processes(processes)
        self.processes = processes
        self.device = device
        self._workers = Workers(processes, fewer=FEWER)

    def __enter__(self) -> Self:
        self._workers.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._workers.__exit__(kind, error, trace)

    def simulate(
        self,
        scenes: Sequence[Scene],
        tiers: Sequence[Tier],
        progress: Callable[[float], None] | None = None,
    ) -> list[list[Outcome]]:
        """Return the outcomes of all scenes by each tier, in order; the tiers are solved at once.

        Args:
            scenes: Scenes to simulate.
            tiers: As in `simulate_many`.
            progress: Called with the fraction of the scenes that are done.

        Raises:
            SceneError: As in `simulate_many`, the other scenes are abandoned; or meshes have to
                agree with those of other processes.
            WorkerLost: A worker was killed, by a lack of memory for example, or could not start.
        """
        count, many = len(scenes), len(scenes) * len(tiers)
        tiers = [self._alike(scenes, tier) for tier in tiers]
        done, self._workers.done = 0, f"0 of {many} scenes"
        tasks = {
            self._workers.submit(_solve, [scenes[i] for i in part], tier, self.device): (
                number,
                part,
            )
            for number, tier in enumerate(tiers)
            for part in self._parts(count, tier)
        }
        found: list[list[Any]] = [[None] * count for _ in tiers]
        for task in as_completed(tasks):
            number, part = tasks[task]
            _raise_error_of(task)
            for index, outcome in zip(part, task.result(), strict=True):
                found[number][index] = outcome
            done += len(part)
            self._workers.done = f"{done} of {many} scenes"
            if progress is not None:
                progress(done / many)
        return found

    def _alike(self, scenes: Sequence[Scene], tier: Tier) -> Tier:
        """Return the tier by which all parts have the topology of the whole, if it asks for one.

        Meshes that follow the contact agree within a part only.
        """
        if not (isinstance(tier, Fem) and tier.one_topology):
            return tier
        if not tier.follows:
            from sim.fem.mesh import agreed

            return agreed(scenes, tier)
        if self.device == "cpu":
            raise SceneError(
                f"fem.one_topology: True with {self.processes} processes, which solve scenes one "
                "by one on meshes that follow the contact; allowed: False, or a spacing"
            )
        return tier

    def _parts(self, count: int, tier: Tier) -> list[range]:
        """Return the scenes of each task: single ones on a CPU, where any process takes the next.

        Beside a GPU each process has a batch. Neighbours in the list are often alike: they take
        equally long, so they are dealt out in turns if all meshes have one topology; else they
        stay with each other, because they often have the same one, and are solved in one launch.
        """
        if self.device == "cpu":
            return [range(one, one + 1) for one in range(count)]
        parts = min(self.processes, count)
        if isinstance(tier, Fem) and not tier.one_topology:
            edges = [count * part // parts for part in range(parts + 1)]
            return [range(first, last) for first, last in itertools.pairwise(edges)]
        return [range(part, count, parts) for part in range(parts)]


def check_processes(processes: int) -> None:
    """Reject an invalid number of processes."""
    if not isinstance(processes, int) or isinstance(processes, bool) or processes < 1:
        raise SceneError(f"processes: {processes!r}; allowed: whole numbers from 1 up")


@contextlib.contextmanager
def running(processes: int | Solvers, device: str, most: int) -> Iterator[Solvers]:
    """Yield running `Solvers` as they are, or new ones for the duration of the block.

    Args:
        processes: As in `simulate_many`.
        device: Device that they must have.
        most: Number of processes beyond which there is nothing to do.
    """
    if isinstance(processes, Solvers):
        if processes.device != device:
            raise SceneError(f"device: {device!r}; allowed with these: {processes.device!r}")
        yield processes
        return
    check_processes(processes)
    with Solvers(min(processes, most), device=device) as solvers:
        yield solvers


def _solve(scenes: Sequence[Scene], tier: Tier, device: str) -> list[Outcome]:
    if device != "cpu" or not isinstance(tier, Layer):
        from sim.device import ready_device

        ready_device(device)  # Warp starts without a banner
    return simulate_many(scenes, tier, device=device)


def _raise_error_of(task: Future[list[Outcome]]) -> None:
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
