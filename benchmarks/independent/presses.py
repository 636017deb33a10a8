"""Presses of this folder as scenes of `sim`, and their forces compared with the stored ones."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.independent.cases import CASES, MM, Case
from benchmarks.independent.foreign_cases import CASES as FOREIGN
from benchmarks.independent.foreign_cases import ForeignCase
from benchmarks.independent.stored import AXISYMMETRIC, GETFEM, load
from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.indenters import (
    Indenter,
    bar,
    box,
    flat_punch,
    rounded_cone,
    sphere,
    torus,
    tube,
)
from sim.indenters.outline import Part
from sim.layer import Layer
from sim.mpm import Mpm
from sim.planning import plan
from sim.scene import Body, Effects, Friction, Scene, press, through
from sim.tiers import simulate


@dataclass(frozen=True)
class Task:
    """A scene of `sim` and the forces of some of its frames by another method."""

    name: str
    kind: str
    """Form of the indenter."""
    scene: Scene
    frames: tuple[int, ...]
    """Frames of the result that have a reference force."""
    truths: tuple[tuple[float, float, float], ...]
    """Force on the body [N]; NaN for unknown components."""
    errors: tuple[float, ...]
    """Uncertainties of the reference forces [%]."""


@dataclass(frozen=True)
class Row:
    """Comparison of one force."""

    case: str
    kind: str
    depth_mm: float
    truth_n: float
    """Size of the force, over the known components."""
    truth_percent: float
    """Its uncertainty."""
    force_n: float | None
    """The same of `sim`; None if it was not solved."""
    error_percent: float | None
    """|force - truth| as vectors over |truth|; signed if only one component is known."""
    stated_percent: float | None
    """Error that the result states of all its forces; None if it states none."""
    seconds: float
    """Time of the whole press."""
    reason: str = ""
    """Why it was not solved."""


def scene_of(case: Case) -> Scene:
    """Return an axisymmetric case as a scene of `sim`."""
    measures = [measure * MM for measure in case.measures]
    indenter: Indenter
    match case.kind:
        case "sphere":
            indenter = sphere(*measures)
        case "punch":
            indenter = flat_punch(*measures)
        case "cone":
            indenter = rounded_cone(math.radians(case.measures[0]), measures[1])
        case "torus":
            indenter = torus(*measures)
        case "tube":
            indenter = tube(*measures)
    body = Body(case.size * MM, case.size * MM, case.thickness * MM, case.modulus, case.poisson)
    effects = Effects(friction=Friction(case.friction)) if case.friction else Effects()
    return Scene(indenter, press([depth * MM for depth in case.depths]), body, effects)


def foreign_scene(case: ForeignCase) -> Scene:
    """Return a case without an axis as a scene of `sim`."""
    measures = [measure * MM for measure in case.measures]
    indenter: Indenter
    match case.shape:
        case "spheres":
            radius = measures[0]
            each = [
                Part("turned", "circle", (0.0, radius, radius), "union", axis=(middle, 0.0))
                for middle in measures[1:] or (0.0,)
            ]
            indenter = Indenter("spheres", tuple(each))
        case "punch":
            indenter = flat_punch(*measures)
        case "bar":
            indenter = bar(*measures)
        case "box":
            indenter = box(*measures)
    if any(case.tilt):
        indenter = indenter.tilted(*map(math.radians, case.tilt))
    dome = case.dome * MM if case.dome else None
    size_x, size_y, thickness = (length * MM for length in case.size)
    body = Body(size_x, size_y, thickness, case.modulus, case.poisson, dome)
    effects = Effects(friction=Friction(case.friction)) if case.friction else Effects()
    x, y, _ = case.path[0]
    points = [(x * MM, y * MM, 0.0)] + [(x * MM, y * MM, -z * MM) for x, y, z in case.path]
    return Scene(indenter, through(points, speed=10e-3), body, effects)


def tasks(only: Sequence[str] = (), *, foreign: bool = True) -> list[Task]:
    """Return the cases whose name has one of the words; all without words.

    Args:
        only: The words.
        foreign: Include cases without an axis.
    """
    scenes: list[tuple[str, str, Scene, Path]] = [
        (case.name, case.kind, scene_of(case), AXISYMMETRIC) for case in CASES
    ]
    if foreign:
        scenes += [(case.name, case.shape, foreign_scene(case), GETFEM) for case in FOREIGN]
    truths = {path: load(path) for path in (AXISYMMETRIC, GETFEM)}
    found = []
    for name, kind, scene, path in scenes:
        rows = [row for row in truths[path] if row.case == name]
        if rows and (not only or any(word in name for word in only)):
            frames = tuple(range(1, len(rows) + 1))
            forces = tuple(row.force for row in rows)
            errors = tuple(row.error_percent for row in rows)
            found.append(Task(name, kind, scene, frames, forces, errors))
    return found


def compared(task: Task, tier: Fem | Layer | Mpm | str, device: str) -> list[Row]:
    """Solve a task by a tier or to a tolerance; rows of a failure say the reason."""
    began = time.perf_counter()
    reason, stated = "", None
    forces: Sequence[Sequence[float]] | None = None
    try:
        if isinstance(tier, str):
            result = plan(task.scene, tier, device=device).run()
        else:
            result = simulate(task.scene, tier, device=device)
        forces = result.force[list(task.frames)].tolist()
        percent = result.record["error"].get("percent")
        stated = None if percent is None else float(percent)
    except (SceneError, SimulationDiverged) as error:
        reason = str(error)
    seconds = time.perf_counter() - began
    rows = []
    for index, (frame, truth, uncertain) in enumerate(
        zip(task.frames, task.truths, task.errors, strict=True)
    ):
        known = [axis for axis in range(3) if not math.isnan(truth[axis])]
        right = math.hypot(*(truth[axis] for axis in known))
        size = off = None
        if forces is not None:
            force = forces[index]
            size = math.hypot(*(force[axis] for axis in known))
            off = math.hypot(*(force[axis] - truth[axis] for axis in known)) / right
            off = 100 * (off if len(known) > 1 else size / right - 1)
        depth = -task.scene.motion.tip[frame][2] / MM
        rows.append(
            Row(task.name, task.kind, depth, right, uncertain, size, off, stated, seconds, reason)
        )
    return rows
