"""Referee: the force of a scene, better than an answer's, and its own uncertainty.

A scene with an axis of symmetry goes to `axial`, which shares no code with the simulator. The
others are solved by the simulator with everything finer: elements, and from them the limit of both
meshes (Richardson 1911, order 2); contact, by more updates of its multipliers; and, where forces
depend on the way or the time, steps. The finest solution must also obey the laws of `mechanics`,
which do not use the solver.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from benchmarks.hard_cases.laws import Array
from benchmarks.hard_cases.random_scenes import axial
from benchmarks.hard_cases.random_scenes.mechanics import silent_laws
from sim.device import kind_of
from sim.error_estimate import vanishing_share, wall_errors, with_symmetry
from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.fem.solver import Required, simulate_fem
from sim.result import Result, force_scale
from sim.scene import Scene
from sim.tolerance import RATIO_LEAST, elements_ratio, left_of_difference

# Updates of the multipliers of contact, of which an answer has 2, and the fraction of what the
# others change the force by that those after them may. Each leaves a tenth of the overlap, but for
# single points at an edge, whose overlap falls with the elements.
TIGHT, AFTER = 6, 0.5
# Elements of the coarser mesh over those of the finer one, more if their numbers hardly differ, and
# the range of the coarser one's fineness: that of the answer, if within. With inertia meshes damp
# waves over a time that falls with their elements, so that they are finer.
FINER, COARSEST, FINEST, FINEST_OF_WAVES = (1.4, 2.0), 0.45, 1.2, 2.0
# Most elements of the finer mesh.
ELEMENTS_MAX = {"cpu": 200_000, "cuda": 2_000_000}
# Number of steps, over those of the answer, with inertia, viscosity or friction.
IN_STEPS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """Force of every frame, and its uncertainty."""

    force: Array
    """(F, 3) [N]."""
    unsure: Array
    """(F,) [N]."""
    by: str
    """The solver and how fine it was."""


class NoReference(Exception):
    """Raised if a scene has no reference, with the reason."""


def reference_of(scene: Scene, fineness: float, factor: int, device: str) -> Reference:
    """Return the reference of an answer on a mesh of that fineness, with that factor on its steps.

    Raises:
        NoReference: No solution, or none that is finer or obeys the laws of mechanics.
    """
    if (along_axis := axial.press_of(scene)) is not None:
        try:
            return Reference(*axial.solved(along_axis), by="axisymmetric elements")
        except axial.NotSolved as error:
            raise NoReference(f"axisymmetric elements: {error}") from error
    try:
        return _by_refining(scene, fineness, factor, device)
    except (SceneError, SimulationDiverged) as error:
        if isinstance(error, SimulationDiverged):
            error.forget_dump()
        raise NoReference(str(error).partition("; state: ")[0]) from error


def _by_refining(scene: Scene, fineness: float, factor: int, device: str) -> Reference:
    effects = scene.effects
    stepwise = effects.viscosity, effects.inertia, effects.friction
    times = IN_STEPS if any(stepwise) else 1
    finest = FINEST if effects.inertia is None else FINEST_OF_WAVES
    fineness = float(np.clip(fineness, COARSEST, finest))
    numerics = Fem(
        fineness=fineness, elements_max=ELEMENTS_MAX[kind_of(device)], step_factor=factor
    )
    solved, needs = partial(_solved, scene, device), Required()
    coarse = solved(numerics, needs)
    for finer in FINER:
        fine = solved(replace(numerics, fineness=finer * fineness), needs)
        if (ratio := elements_ratio(coarse, fine)) >= RATIO_LEAST:
            break
    else:
        raise NoReference("a finer mesh has too many elements")
    if broken := silent_laws(with_symmetry(fine)):
        raise NoReference(f"its finest solution breaks laws of mechanics: {', '.join(broken)}")
    apart = fine.force - coarse.force
    second = left_of_difference(ratio)
    # Half of the correction; with inertia at least half of what an error of order 1 would add.
    first = 0.0 if effects.inertia is None else left_of_difference(ratio, order=1.0) - second
    force = fine.force + second * apart
    unsure = max(second, first) / 2 * np.abs(apart).max(axis=1)
    tight = solved(replace(numerics, augmentations=TIGHT), Required())
    change = tight.force - coarse.force
    force, unsure = force + change, unsure + AFTER * np.abs(change).max(axis=1)
    if times > 1:
        small = solved(replace(numerics, step_factor=times * factor), Required())
        change = small.force - coarse.force
        force, unsure = force + change, unsure + np.abs(change).max(axis=1) / (times - 1)
    more = vanishing_share(fine) + wall_errors(fine)
    if (stiffening := fine.record.get("stiffening")) is not None:
        more = more + np.array(stiffening["correction"])
    unsure = unsure + more * force_scale(force)
    sunk = 100 * np.nan_to_num(tight.quality.contact).max()
    by = f"fineness {fine.record['mesh']['fineness']:.2g}, steps x {times}, sunk {sunk:.2g} %"
    return Reference(force, unsure, by)


def _solved(scene: Scene, device: str, numerics: Fem, required: Required) -> Result:
    (outcome,) = simulate_fem([scene], numerics, device=device, required=required)
    if isinstance(outcome, SimulationDiverged):
        raise outcome
    return outcome
