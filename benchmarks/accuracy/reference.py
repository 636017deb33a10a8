"""Reference solutions: `fem`, with finer meshes and tighter tolerances than all competitors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

from benchmarks.accuracy.competitors import in_launches
from benchmarks.accuracy.errors import compare, frames
from recorder.processes import Workers
from sim.errors import SimulationDiverged
from sim.metrics import Outcome, outcome_of
from sim.result import Result
from sim.scene import Motion, Scene
from sim.tiers import simulate_many

if TYPE_CHECKING:
    from benchmarks.accuracy.cases import Case
    from sim.fem import Fem

# Element size of the second reference over that of the first. If errors decrease with the square of
# the element size, the error of the first is 0.8 of the difference.
COARSER = 1.5
# Number of parts that each piece of a viscous motion is divided into, which refines the time steps.
VISCOUS_PARTS = 3


@dataclass(frozen=True, slots=True)
class Reference:
    """Reference of one scene, and its accuracy."""

    outcome: Outcome
    uncertainty: dict[str, float]
    """Difference of the two finest meshes for each error of `Errors.worst`; empty: not known."""


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
    processes: int | Workers,
) -> list[Outcome | SimulationDiverged]:
    """Solve scenes that share a body; the outcomes have the frames of each scene.

    `processes` beside a GPU are as in `simulate_many`.
    """
    parts = VISCOUS_PARTS if scenes[0].effects.viscosity is not None else 1
    cut = [replace(scene, motion=finer(scene.motion, parts)) for scene in scenes]
    numerics = reference_numerics(fineness)
    outcomes: list[Outcome | SimulationDiverged] = []

    def solve(some: Sequence[Scene], where: str) -> list[Result | SimulationDiverged]:
        return simulate_many(some, numerics, device=where, processes=processes)

    for scene, one in zip(scenes, in_launches(solve, cut, device), strict=True):
        if isinstance(one, SimulationDiverged):
            outcomes.append(one)
        else:
            outcomes.append(
                frames(outcome_of(one), list(range(0, parts * len(scene.motion), parts)))
            )
    return outcomes


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


def references(case: Case, device: str, processes: int | Workers) -> list[Reference | None]:
    """Return the references of a case's scenes, or None where there is no solution.

    `processes` beside a GPU are as in `simulate_many`.
    """
    fine, coarse = (
        solve_references(case.scenes, fineness, device, processes)
        for fineness in (case.fineness, case.fineness / COARSER)
    )
    answers: list[Reference | None] = []
    for scene, true, rough in zip(case.scenes, fine, coarse, strict=True):
        if isinstance(true, SimulationDiverged):
            answers.append(None)
        elif isinstance(rough, SimulationDiverged):
            answers.append(Reference(true, {}))
        else:
            answers.append(Reference(true, compare(rough, true, scene.body).worst()))
    return answers
