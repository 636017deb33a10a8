"""Error by the time steps of scenes with viscosity or inertia, and the number of steps it needs.

With inertia the scene is solved on a coarse mesh in as many steps as on its own, and in twice as
many. Viscosity alone has no companion: its steps are those of a force that follows the depth by
a power, for which the response is known.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sim.arrays import Array, Progress
from sim.errors import SimulationDiverged
from sim.fem import Fem
from sim.fem.mesh import outline_of
from sim.fem.solver import Required, simulate_fem
from sim.fem.stepping import OutOfTime, Path, path_of
from sim.result import Outcome, Result, force_scale
from sim.scene import Scene

# Error of the force by time steps that is sought, and most times as many steps as usual.
SOUGHT, FACTOR_MOST = 0.02, 4
# Ratio of both numbers of steps, and the error of the smaller one over the difference of forces,
# if it falls as the step does.
FINER, OF_DIFFERENCE = 2, 2.0
# Error by more steps, over that by fewer, above which they are not worth their time.
WORTH = 0.75
# Fineness of the coarse mesh.
FINENESS = 0.3
# Error of frames that the coarse mesh has no solution for, over the largest of those that it has,
# and the error without any.
BEYOND, UNMEASURED = 2.0, 0.3
# Power of the depth with which the force of a cone grows, that of all shapes grows most; steps of
# the reference over those of the path; and the error over that of such a force.
POWER, EXACT, OF_POWER = 2.0, 8, 2.0


class TimeSteps(NamedTuple):
    """Steps in time of a scene, and their error."""

    factor: int
    """Factor on the number of steps, for `Fem.step_factor`."""
    force: Array
    """Error by time steps of each frame (F,), over the force."""


def simulate_in_time(
    scenes: Sequence[Scene],
    numerics: Fem = Fem(),
    *,
    device: str = "cpu",
    progress: Progress | None = None,
) -> list[Outcome]:
    """Return the outcomes of `simulate_fem`, with `record["time"]`: `factor` and `force`."""
    steps = [time_steps(scene, numerics, device) for scene in scenes]
    factors = [1 if one is None else one.factor for one in steps]
    if numerics.one_topology:
        factors = [max(factors, default=1)] * len(scenes)
    outcomes: dict[int, Outcome] = {}
    for factor in sorted(set(factors)):
        chosen = [i for i, one in enumerate(factors) if one == factor]
        settings = numerics if factor == 1 else replace(numerics, step_factor=factor)
        some = simulate_fem([scenes[i] for i in chosen], settings, device=device, progress=progress)
        outcomes.update(zip(chosen, some, strict=True))
    return [with_time(outcomes[i], one, numerics) for i, one in enumerate(steps)]


def with_time(outcome: Outcome, steps: TimeSteps | None, numerics: Fem) -> Outcome:
    """Return an outcome with the error by time `steps` of its result or the part reached."""
    if isinstance(outcome, SimulationDiverged):
        if outcome.reached is not None:
            outcome.reached = with_time(outcome.reached, steps, numerics)
        return outcome
    if steps is None:
        scene, finest = outcome.scene, outcome.record["mesh"]["finest"]
        if scene.effects.viscosity is None:
            return outcome
        followed = finest / scene.body.thickness if numerics.follows else np.inf
        path = path_of(scene, numerics, followed)
        few, many = (_relaxing(scene, path, finer) for finer in (1, EXACT))
        error = OF_POWER * np.abs(few - many) / force_scale(many[:, None])
        steps = TimeSteps(path.factor, np.asarray(error))
    force = [float(f"{one:.4g}") for one in steps.force[: len(outcome.force)]]
    time = {"factor": steps.factor, "force": force}
    return replace(outcome, record={**outcome.record, "time": time})


def time_steps(
    scene: Scene,
    numerics: Fem,
    device: str,
    sought: float = SOUGHT,
    fineness: float = FINENESS,
    required: Required | None = None,
) -> TimeSteps | None:
    """Return the steps in time of a scene and their error; None without inertia.

    With `numerics.step_factor` that many; else as many as an error of `sought` needs, on a mesh of
    this `fineness`, or as the scene's own if the time for others is over. `required` is what
    coarser meshes have shown the mesh to need; it is not rebuilt then.
    """
    if scene.effects.inertia is None:
        return None
    path = path_of(scene, numerics, outline_of(scene, numerics)[1] if numerics.follows else np.inf)
    travel = min(path.longest * scene.body.thickness, 1.0)  # infinite for a plane
    coarse = Fem(fineness=fineness, step_travel=travel, tolerance=numerics.tolerance)
    solved: dict[int, Array] = {}

    def with_error(factor: int) -> TimeSteps:
        for times in {factor, FINER * factor} - set(solved):
            settings = replace(coarse, step_factor=times)
            sizes = required and Required(dict(required.sizes), dict(required.stiffer))
            solved[times] = _forces(*simulate_fem([scene], settings, device=device, required=sizes))
        return TimeSteps(factor, _of_inertia(solved[factor], solved[FINER * factor], scene))

    if numerics.step_factor is not None:
        return with_error(path.factor)
    best, factor = unmeasured(scene), 1
    with suppress(OutOfTime):  # measurements until then count
        best = with_error(1)
        while best.force.max(initial=0.0) > sought and factor < FACTOR_MOST:
            factor *= FINER  # one more solution each time
            more = with_error(factor)
            if more.force.max() > WORTH * best.force.max():
                break
            best = more
    return best


def unmeasured(scene: Scene) -> TimeSteps:
    """Return as many steps in time as usual, and their error without a measurement."""
    return TimeSteps(1, np.full(len(scene.motion), UNMEASURED))


def _of_inertia(few: Array, many: Array, scene: Scene) -> Array:
    """Return the error of forces (F, 3) in few steps, by others in `FINER` times as many (F,).

    Those of a path without a solution have fewer frames.
    """
    count = min(len(few), len(many))
    if not count:
        return unmeasured(scene).force
    apart = np.abs(few[:count] - many[:count]).max(axis=1) / force_scale(many[:count])
    apart = with_neighbours(apart)
    beyond = np.full(len(scene.motion) - count, BEYOND * apart.max())
    return np.asarray(OF_DIFFERENCE * np.concatenate([apart, beyond]))


def with_neighbours(apart: Array) -> Array:
    """Return differences of two swings in each frame (F,), each at least half of its neighbours'.

    If they are not in step, a frame may see the moment at which they are equal.
    """
    near = np.pad(apart, 1)
    return np.asarray(np.maximum(near[1:-1], np.maximum(near[:-2], near[2:]) / 2))


def _forces(outcome: Outcome) -> Array:
    """Return the forces of an outcome (F, 3), or those up to where it has no solution."""
    result = outcome
    if isinstance(outcome, SimulationDiverged):
        outcome.forget_dump()
        result = outcome.reached
    return result.force if isinstance(result, Result) else np.zeros((0, 3))


def _relaxing(scene: Scene, path: Path, finer: int) -> Array:
    """Return the viscous force of a power of the depth (F,), elastically linear over a step."""
    viscosity = scene.effects.viscosity
    assert viscosity is not None
    ratios, times = np.array(viscosity.ratios), np.array(viscosity.times)
    corners = np.maximum(-path.corners[:, 2], 0.0)
    elastic, branches, forces = 0.0, np.zeros(len(times)), []
    for segment in range(len(corners) - 1):
        steps = int(path.steps_of(segment)) * (finer if segment else 1)
        step = (path.times[segment + 1] - path.times[segment]) / steps
        decay = np.exp(-step / times)
        fraction = times / step * (1.0 - decay) if step else np.ones(len(times))
        depths = np.linspace(corners[segment], corners[segment + 1], steps + 1)[1:]
        for after in depths**POWER:
            branches = decay * branches + ratios * fraction * (after - elastic)
            elastic = after
        forces.append(elastic + branches.sum())
    return np.array(forces)
