"""One timed run of some presses: its time, memory, iterations and outcomes."""

from __future__ import annotations

import os
import resource
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from benchmarks.sim.speed.record import Run
from benchmarks.sim.spent import Spent, peak_memory, spent_by
from sim.errors import SimulationDiverged
from sim.result import Outcome, Result
from sim.scene import Body, Scene, press
from sim.tiers import simulate_many

if TYPE_CHECKING:
    from sim.fem import Fem
    from sim.mpm import Mpm

Value = TypeVar("Value")
# Function from scenes and a progress callback to outcomes.
Solve = Callable[[Sequence[Scene], Callable[[float], None]], list[Outcome]]

# Depth of the press that loads the kernels [m].
WARM = 0.02e-3
TINY = Body(4e-3, 4e-3, 4e-3)
# Interval between checks of the workers' memory [s].
LOOK_EVERY = 0.1


def timed(
    run: Run, scenes: Sequence[Scene], solve: Solve, device: str
) -> tuple[Run, list[Outcome]]:
    """Solve `scenes` and return `run` with the cost, and their outcomes."""
    from recorder.progress import Progress

    def work() -> list[Outcome]:
        with Progress(f"{run.part}: {run.name}", sys.stderr) as progress:
            return solve(scenes, progress)

    outcomes, spent = spent_with_workers(work, device, run.processes)
    return counted(
        replace(
            run,
            presses=len(scenes),
            seconds=spent.wall,
            cpu=spent.cpu,
            memory=spent.memory,
        ),
        outcomes,
    ), outcomes


def fem(numerics: Fem, device: str, processes: int = 1) -> Solve:
    """Return a function that solves scenes by finite elements."""

    def solve(scenes: Sequence[Scene], progress: Callable[[float], None]) -> list[Outcome]:
        return simulate_many(
            scenes, numerics, device=device, processes=processes, progress=progress
        )

    return solve


def mpm(numerics: Mpm, device: str) -> Solve:
    """Return a function that solves scenes by material points."""

    def solve(scenes: Sequence[Scene], progress: Callable[[float], None]) -> list[Outcome]:
        return simulate_many(scenes, numerics, device=device, progress=progress)

    return solve


def counted(run: Run, outcomes: Sequence[Outcome]) -> Run:
    """Return `run` with the mesh sizes and iterations of all its presses."""
    solved = [one for one in outcomes if isinstance(one, Result)]
    failed = [one for one in outcomes if isinstance(one, SimulationDiverged)]
    run = replace(run, failed=len(failed), note=run.note or (str(failed[0]) if failed else ""))
    if any("mesh" not in one.record or "elements" not in one.record["mesh"] for one in solved):
        return replace(
            run,
            elements=sum(int(one.record["particles"]) for one in solved),
            newton=sum(int(one.record["steps"]) for one in solved),
        )
    meshes = [one.record["mesh"] for one in solved]
    newton = [int(one.quality.newton.sum()) for one in solved]
    cg = [int(one.quality.cg.sum()) for one in solved]
    return replace(
        run,
        groups=len({tuple(mesh["cells"]) for mesh in meshes}),
        elements=sum(mesh["elements"] for mesh in meshes),
        nodes=sum(mesh["nodes"] for mesh in meshes),
        newton=sum(newton),
        newton_first=sum(_first(one.quality.newton) for one in solved),
        cg=sum(cg),
        newton_elements=sum(n * mesh["elements"] for n, mesh in zip(newton, meshes, strict=True)),
        newton_nodes=sum(n * mesh["nodes"] for n, mesh in zip(newton, meshes, strict=True)),
        cg_nodes=sum(n * mesh["nodes"] for n, mesh in zip(cg, meshes, strict=True)),
    )


def _first(newton: NDArray[np.int64]) -> float:
    """Return iterations of the first depth beyond a later one's; the first frame only touches."""
    return float(newton[1] - newton[2:].mean()) if len(newton) > 2 else 0.0


def warm_up(scene: Scene, numerics: Fem, device: str, kernels: Path | None) -> tuple[float, int]:
    """Return seconds of a first, shallow press in both precisions, and the modules compiled.

    Both are needed because presses that fail in float32 are solved again in float64.
    """
    from recorder.progress import Progress

    before = _entries(kernels)
    began = time.perf_counter()
    with Progress("first presses", sys.stderr, kernels=kernels):
        shallow = replace(scene, motion=press([WARM]))
        for precision in ("float32", "float64"):
            simulate_many([shallow], replace(numerics, precision=precision), device=device)
    return time.perf_counter() - began, _entries(kernels) - before


def warm_up_mpm(scene: Scene, numerics: Mpm, device: str) -> None:
    """Load the kernels of `mpm` with the same scene on a body of a few particles."""
    tiny = replace(scene, motion=press([1e-6]), body=TINY)
    simulate_many([tiny], numerics, device=device)


def spent_with_workers(
    work: Callable[[], Value], device: str, processes: int
) -> tuple[Value, Spent]:
    """Measure like `spent_by`, including the processes that `work` starts."""
    if processes == 1:
        return spent_by(work, device)
    most: dict[int, int] = {}
    done = threading.Event()

    def look() -> None:
        while not done.wait(LOOK_EVERY):
            for worker in _children():
                most[worker] = max(most.get(worker, 0), _peak(worker))

    watcher = threading.Thread(target=look, name="memory", daemon=True)
    watcher.start()
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    try:
        value, spent = spent_by(work, device)
    finally:
        done.set()
        watcher.join()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    memory = peak_memory() + sum(most.values()) if most else 0
    return value, Spent(spent.wall, spent.cpu + cpu, memory)


def _children() -> list[int]:
    """Return the child processes of this process, or none if the system does not list them."""
    found = []
    for listed in Path(f"/proc/{os.getpid()}/task").glob("*/children"):
        try:
            found += [int(word) for word in listed.read_text().split()]
        except OSError:
            continue
    return found


def _peak(process: int) -> int:
    """Return the peak memory of a process [bytes]; 0 once it has ended."""
    try:
        text = Path(f"/proc/{process}/status").read_text()
    except OSError:
        return 0
    for line in text.splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    return 0


def _entries(folder: Path | None) -> int:
    return sum(1 for _ in folder.iterdir()) if folder is not None and folder.is_dir() else 0
