"""Referee: the force of a scene, better than an answer's, and its own uncertainty.

A scene with an axis of symmetry goes to `axial`, which shares no code with the simulator. The
others are solved by the simulator with everything finer: elements, and from them the limit of both
meshes (Richardson 1911, order 2); contact, whose overlap is at most a thousandth of the depth; and,
where forces depend on the way or the time, steps (order 1). The finest solution must also obey the
laws of `mechanics`, which do not use the solver.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from benchmarks.hard_cases.laws import Array
from benchmarks.hard_cases.random_scenes import axial
from benchmarks.hard_cases.random_scenes.mechanics import silent_laws
from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.fem.stepping import path_of
from sim.result import Result, force_scale
from sim.scene import Motion, Scene
from sim.tiers import simulate
from sim.tolerance import RATIO_LEAST, elements_ratio, left_of_difference

# Contact stiffness and updates of its multipliers, first and if the overlap is too large: the
# simulator's own are 200 and 2.
TIGHT = ((1600.0, 4), (12_800.0, 10))
# Largest overlap, over the depth, and the error of a force over it.
OVERLAP, PER_OVERLAP = 1e-3, 2.0
# Elements of the coarser mesh over those of the finer one, and the range of the coarser one's
# fineness: that of the answer, if within.
FINER, COARSEST, FINEST = 1.4, 0.45, 1.2
# Most elements of the finer mesh.
ELEMENTS_MAX = {"cpu": 200_000, "cuda": 2_000_000}
# Number of steps, over those of the simulator: with inertia or viscosity, and with friction alone.
IN_TIME, ALONG = 4, 2
# Most steps of a segment.
STEPS_MAX = 64


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


def reference_of(scene: Scene, fineness: float, device: str) -> Reference:
    """Return the reference of an answer on a mesh of that fineness.

    Raises:
        NoReference: No solution, or none that is finer or obeys the laws of mechanics.
    """
    if (along_axis := axial.press_of(scene)) is not None:
        try:
            return Reference(*axial.solved(along_axis), by="axisymmetric elements")
        except axial.NotSolved as error:
            raise NoReference(f"axisymmetric elements: {error}") from error
    try:
        return _by_refining(scene, fineness, device)
    except (SceneError, SimulationDiverged) as error:
        if isinstance(error, SimulationDiverged):
            error.forget_dump()
        raise NoReference(str(error).partition("; state: ")[0]) from error


def _by_refining(scene: Scene, fineness: float, device: str) -> Reference:
    effects = scene.effects
    in_time = effects.viscosity is not None or effects.inertia is not None
    times = IN_TIME if in_time else ALONG if effects.friction is not None else 1
    fineness = float(np.clip(fineness, COARSEST, FINEST))
    steps = _steps(scene) if times > 1 else None
    coarse, tight = _tightly(scene, fineness, steps, device)
    fine = _solved(scene, FINER * fineness, steps, tight, device)
    ratio = elements_ratio(coarse, fine)
    if ratio < RATIO_LEAST:
        raise NoReference("a finer mesh has too many elements")
    if broken := silent_laws(fine):
        raise NoReference(f"its finest solution breaks laws of mechanics: {', '.join(broken)}")
    meshes = (fine.force - coarse.force) * left_of_difference(ratio)
    rows = _frames(scene, steps)
    force, unsure = fine.force + meshes, np.abs(meshes).max(axis=1) / 2
    if steps is not None:
        many = [times * count for count in steps]
        small = _solved(scene, fineness, many, tight, device)
        change = small.force[_frames(scene, many)] - coarse.force[rows]
        force, unsure = force[rows] + change * times / (times - 1), unsure[rows]
        unsure = unsure + np.abs(change).max(axis=1) / (times - 1)
    overlap = np.nan_to_num(fine.quality.contact[rows])
    unsure = unsure + PER_OVERLAP * overlap * force_scale(force)
    by = f"fineness {fine.record['mesh']['fineness']:.2g}, steps x {times}"
    return Reference(force, unsure, f"{by}, overlap {100 * overlap.max():.2g} %")


def _tightly(
    scene: Scene, fineness: float, steps: list[int] | None, device: str
) -> tuple[Result, tuple[float, int]]:
    """Return a solution with little overlap, and the contact settings that it needs."""
    for tight in TIGHT:
        result = _solved(scene, fineness, steps, tight, device)
        if np.nan_to_num(result.quality.contact).max() <= OVERLAP:
            break
    return result, tight


def _solved(
    scene: Scene, fineness: float, steps: list[int] | None, tight: tuple[float, int], device: str
) -> Result:
    if steps is not None:
        scene = replace(scene, motion=_in_steps(scene.motion, steps))
    most = ELEMENTS_MAX["cpu" if device == "cpu" else "cuda"]
    penalty, augmentations = tight
    numerics = Fem(
        fineness=fineness, elements_max=most, penalty=penalty, augmentations=augmentations
    )
    return simulate(scene, numerics, device=device)


def _steps(scene: Scene) -> list[int]:
    """Return the number of steps that the simulator takes to each waypoint but the first."""
    path, steps = path_of(scene, Fem()), []
    for segment in range(1, len(scene.motion)):
        path.segment = segment
        steps.append(min(max(round(1 / path.limit), 1), STEPS_MAX // IN_TIME))
    return steps


def _in_steps(motion: Motion, steps: list[int]) -> Motion:
    """Return the motion with each move, and each rest, in equal parts: `steps` of each."""
    corners = np.column_stack([motion.tip, motion.time])
    rows = [corners[:1]]
    for start, end, count in zip(corners[:-1], corners[1:], steps, strict=True):
        rows.append(start + (end - start) * np.arange(1, count + 1)[:, None] / count)
    way = np.concatenate(rows)
    return Motion(tuple(map(tuple, way[:, :3].tolist())), tuple(way[:, 3].tolist()))


def _frames(scene: Scene, steps: list[int] | None) -> list[int]:
    """Return the frames of a motion in steps that are those of the scene."""
    if steps is None:
        return list(range(len(scene.motion)))
    return [0, *np.cumsum(steps).tolist()]
