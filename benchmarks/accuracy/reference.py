"""Reference solutions: `fem`, with finer meshes and tighter tolerances than all competitors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

from benchmarks.accuracy.errors import compare, frames
from sim.errors import SimulationDiverged
from sim.metrics import Outcome, outcome_of
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


def solve_reference(scene: Scene, fineness: float, device: str) -> Outcome | SimulationDiverged:
    """Solve a scene; the outcome has its frames."""
    parts = VISCOUS_PARTS if scene.effects.viscosity is not None else 1
    cut = replace(scene, motion=finer(scene.motion, parts))
    (one,) = simulate_many([cut], reference_numerics(fineness), device=device)
    if isinstance(one, SimulationDiverged):
        return one
    return frames(outcome_of(one), list(range(0, parts * len(scene.motion), parts)))


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


def reference_of(case: Case, device: str) -> Reference | None:
    """Return the reference of a case, or None if there is no solution."""
    true, rough = (
        solve_reference(case.scene, fineness, device)
        for fineness in (case.fineness, case.fineness / COARSER)
    )
    if isinstance(true, SimulationDiverged):
        return None
    if isinstance(rough, SimulationDiverged):
        return Reference(true, {})
    return Reference(true, compare(rough, true, case.scene.body).worst())
