"""Reference solutions: `fem`, with finer meshes and tighter tolerances than all competitors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.sim.accuracy.errors import compare, frames, load, save
from benchmarks.sim.launches import in_launches
from recorder.processes import Workers
from sim.errors import SimulationDiverged
from sim.metrics import Outcome, outcome_of
from sim.result import Result
from sim.scene import Motion, Scene
from sim.tiers import simulate_many

if TYPE_CHECKING:
    from benchmarks.sim.accuracy.cases import Case
    from sim.fem import Fem

# Element size of the second reference over that of the first. If errors decrease with the square of
# the element size, the error of the first is 0.8 of the difference.
COARSER = 1.5
# Number of parts that each piece of a viscous motion is divided into, which refines the time steps.
VISCOUS_PARTS = 3
# Version of the cache file; other versions are computed again.
FORMAT = 3


@dataclass(frozen=True, slots=True)
class Reference:
    """Reference of one scene, and its accuracy."""

    outcome: Outcome
    uncertainty: dict[str, float]
    """Difference of the two finest meshes for each error of `Errors.worst`."""


# Maximum number of elements of a reference mesh.
ELEMENTS_MAX = 1_000_000


def reference_numerics(fineness: float) -> Fem:
    """Return settings with the finest mesh, no penetration, and a tenth of the tolerance."""
    from sim.fem import Fem

    return Fem(
        fineness=fineness,
        precision="float64",
        tolerance=1e-5,
        path_tolerance=1e-3,
        augmentations=5,
        elements_max=ELEMENTS_MAX,
    )


def solve_references(
    scenes: Sequence[Scene],
    fineness: float,
    device: str,
    processes: int | Workers = 1,
) -> list[Outcome | SimulationDiverged]:
    """Solve scenes that share a body; the outcomes have the frames of each scene.

    `processes` beside a GPU are as in `simulate_many`.
    """
    parts = VISCOUS_PARTS if scenes[0].effects.viscosity is not None else 1
    cut = [replace(scene, motion=finer(scene.motion, parts)) for scene in scenes]
    numerics = reference_numerics(fineness)
    kept: list[Outcome | SimulationDiverged] = []

    def solve(some: Sequence[Scene], where: str) -> list[Result | SimulationDiverged]:
        return simulate_many(some, numerics, device=where, processes=processes)

    for scene, one in zip(scenes, in_launches(solve, cut, device), strict=True):
        if isinstance(one, SimulationDiverged):
            kept.append(one)
        else:
            kept.append(frames(outcome_of(one), list(range(0, parts * len(scene.motion), parts))))
    return kept


def finer(motion: Motion, parts: int) -> Motion:
    """Return the same motion with each piece cut into `parts`, the waypoints being every nth."""
    tip, time = [motion.tip[0]], [motion.time[0]]
    pieces = pairwise(zip(motion.tip, motion.time, strict=True))
    for (start, begin), (end, finish) in pieces:
        for part in range(1, parts + 1):
            fraction = part / parts
            x, y, z = (a + (b - a) * fraction for a, b in zip(start, end, strict=True))
            tip.append((x, y, z) if part < parts else end)
            time.append(begin + (finish - begin) * fraction if part < parts else finish)
    return Motion(tip=tuple(tip), time=tuple(time))


def references(
    case: Case,
    fineness: float,
    device: str,
    cache: Path,
    say: Callable[[str], None],
    processes: int = 1,
) -> list[Reference | None]:
    """Return the references of a case's scenes, or None where not found; results are cached.

    Args:
        case: Scenes that share a body, and their name.
        fineness: Fineness of the finest mesh.
        device: Device to compute on.
        cache: Folder of cached references.
        say: Called with progress messages.
        processes: Number of processes beside a GPU, each with a part of the scenes.
    """
    with Workers(processes) as started:
        solvers = started if processes > 1 else 1
        fine, coarse = (
            _outcomes(case, size, device, cache, say, solvers)
            for size in (fineness, fineness / COARSER)
        )
    references_: list[Reference | None] = []
    for index, scene in enumerate(case.scenes):
        true, rough = fine.get(str(index)), coarse.get(str(index))
        if true is None:
            references_.append(None)
            continue
        unknown = {"force": np.nan}
        uncertainty = unknown if rough is None else compare(rough, true, scene.body).worst()
        references_.append(Reference(true, uncertainty))
    return references_


def _outcomes(
    case: Case,
    fineness: float,
    device: str,
    cache: Path,
    say: Callable[[str], None],
    processes: int | Workers,
) -> dict[str, Outcome]:
    """Return the outcomes of a case on one mesh, by the number of the scene; they are cached."""
    path = cache / f"{case.name}-{fineness:.4g}-{FORMAT}.npz"
    if not path.exists():
        say(f"reference of {case.name}: fineness {fineness:.3g}")
        found: dict[str, Outcome] = {}
        for index, one in enumerate(solve_references(case.scenes, fineness, device, processes)):
            if isinstance(one, SimulationDiverged):
                say(f"  no reference of scene {index}: {one}")
            else:
                found[str(index)] = one
        save(path, found)
    return load(path)
