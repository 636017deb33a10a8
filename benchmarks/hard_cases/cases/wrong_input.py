"""Wrong input: rejected by name before a run; impossible numerics are rejected with evidence."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

from benchmarks.hard_cases.cases.bodies import MM, PAD, SPHERE
from benchmarks.hard_cases.laws import Law, alike, at_least, at_most, difference, evidence
from benchmarks.hard_cases.solver import Case, Solver
from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.indenters import Part, named, shapes
from sim.scene import Body, Effects, Friction, Gravity, Inertia, Motion, Scene, Viscosity, press

# Sets one field of a scene to a number, which must be rejected.
Make = Callable[[float], object]


def _with(owner: Any, name: str, value: float) -> object:
    return replace(owner, **{name: value})


def _along(axis: int, value: float) -> tuple[float, ...]:
    return tuple(value if axis == each else 0.0 for each in range(3))


def _fields() -> Iterator[tuple[str, Make]]:
    """Yield every number of a scene: the name that its rejection must contain, and its setter."""
    for name in ("size_x", "size_y", "thickness", "modulus", "poisson", "dome_radius", "density"):
        yield name, partial(_with, Body(), name)
    yield "coefficient", Friction
    yield "ratios", lambda value: Viscosity(ratios=(value,), times=(1.0,))
    yield "times", lambda value: Viscosity(ratios=(1.0,), times=(value,))
    yield "scale", Inertia
    start: Any = (0.0, 0.0, 0.0)
    for axis in range(3):
        pull: Any = partial(_along, axis)
        yield f"acceleration[{axis}]", lambda value, pull=pull: Gravity(pull(value))  # type: ignore[misc]
        yield "tip[1]", lambda value, pull=pull: Motion((start, pull(value)), (0.0, 1.0))  # type: ignore[misc]
    yield "time", lambda value: Motion((start, start), (0.0, value))
    yield "time", lambda value: Motion((start, start), (value, 1.0))
    yield "speed", lambda value: press([1 * MM], speed=value)
    yield "depths[0]", lambda value: press([value])
    yield "motion.at", lambda value: press([1 * MM], at=(value, 0.0))
    yield "shear", lambda value: press([1 * MM], shear=value)
    yield "tip", lambda value: press([1 * MM], shear=1 * MM, angle=value)
    yield "hold", lambda value: press([1 * MM], hold=value)
    yield "edge_radius", lambda value: named("prism", value)
    yield "narrowest", partial(_with, named("prism"), "narrowest")
    yield "radius", shapes.sphere
    yield "radius", lambda value: shapes.flat_punch(value, 0.1 * MM)
    yield "half_angle", lambda value: shapes.cone(value, 0.3 * MM)
    circle = Part("turned", "circle", (0.0, MM, MM), "union")
    yield "values", lambda value: _with(circle, "values", (0.0, value, MM))  # type: ignore[arg-type]
    yield "values", lambda value: shapes.extruded((0, 0, 0, MM, 0, 0, MM, value, 0))
    yield "cosine", partial(_with, circle, "cosine")
    yield "axis", lambda value: replace(circle, axis=(0.0, value))


def _refusals(fields: Iterable[tuple[str, Make]], value: float) -> list[Law]:
    """Count the fields that accepted the value, and those rejected without their name."""
    accepted, nameless = [], []
    for name, make in fields:
        try:
            make(value)
            accepted.append(name)
        except ValueError as error:
            if not isinstance(error, SceneError) or name not in str(error):
                nameless.append(name)
    return [
        at_most(f"fields that accepted {value:g} {accepted or ''}", len(accepted), 0),
        at_most(f"rejections of {value:g} without a name {nameless or ''}", len(nameless), 0),
    ]


def _not_a_number(_solver: Solver) -> list[Law]:
    """NaN in any number of a scene is rejected by the field's name; no scene is created."""
    return _refusals(_fields(), math.nan)


def _infinite(_solver: Solver) -> list[Law]:
    """Infinity likewise, except for the widest wall, where it means none."""
    return _refusals([field for field in _fields() if field[0] != "narrowest"], math.inf)


def _below_zero(_solver: Solver) -> list[Law]:
    """Negative lengths, moduli, coefficients and times are rejected."""
    signed = ("acceleration", "tip", "depths", "motion.at", "shear", "values", "axis", "cosine")
    return _refusals([field for field in _fields() if not field[0].startswith(signed)], -1.0)


def _millimetres_for_metres(_solver: Solver) -> list[Law]:
    """A body or a depth in millimetres is rejected; the message asks about the units."""
    fields: list[tuple[str, Make]] = [
        ("size_x", lambda value: Body(size_x=20 * value, size_y=20 * value, thickness=4 * value)),
        ("are the units metres?", lambda value: Scene(SPHERE, press([1.5 * value]))),
        ("radius", lambda value: shapes.sphere(4 * value)),
    ]
    return _refusals(fields, 1.0)


def _phases_without_time(_solver: Solver) -> list[Law]:
    """Phases of zero length (the same depth twice, the same time twice) are rejected: no time."""
    fields: list[tuple[str, Make]] = [
        ("depths", lambda value: press([1 * MM, 1 * MM + value])),
        ("time", lambda value: Motion(tip=((value, value, value),) * 2, time=(0.0, value))),
    ]
    return _refusals(fields, 0.0)


def _numerics_not_a_number(solver: Solver) -> list[Law]:
    """NaN in the solver's settings is rejected by name, before a step is taken."""
    steps: list[float] = []
    scene = Scene(SPHERE, press([0.2 * MM]), Body(4 * MM, 4 * MM, 3 * MM))

    def solve(name: str, value: float) -> object:
        numerics: Any = _with(Fem(spacing=1 * MM, halvings=0), name, value)
        return solver.outcomes([scene], numerics, progress=steps.append)

    names = ("spacing", "tolerance", "penalty", "step_travel")
    laws = _refusals([(name, partial(solve, name)) for name in names], math.nan)
    return [*laws, at_most("steps that were taken", len(steps), 0)]


def _unlike_bodies_in_a_batch(solver: Solver) -> list[Law]:
    """Bodies of different size, or effects, in one call: each gets the same result as alone."""
    base = Scene(SPHERE, press([0.5 * MM]), PAD)
    scenes = [
        base,
        replace(base, body=replace(PAD, thickness=5 * MM)),
        replace(base, body=replace(PAD, size_x=11 * MM)),
        replace(base, effects=Effects(friction=Friction(0.1))),
    ]
    return [
        at_most("difference from the result alone", difference(solver.one(scene).force, both), 0)
        for scene, both in zip(scenes, (r.force for r in solver.many(scenes)), strict=True)
    ]


def _gives_up(solver: Solver, **numerics: object) -> list[Law]:
    try:
        solver.one(Scene(SPHERE, press([1 * MM]), PAD), **numerics)
    except SimulationDiverged as diverged:
        return evidence(diverged)
    return [at_least("refused", 0, 1)]


def _one_newton_iteration(solver: Solver) -> list[Law]:
    """Limited to one Newton iteration and one halving, it reports this and its last state."""
    return _gives_up(solver, newton_max=1, halvings=1)


def _out_of_reach(solver: Solver) -> list[Law]:
    """A tolerance below float32's digits is rejected in float32, not ignored."""
    return _gives_up(solver, precision="float32", tolerance=1e-9, halvings=2)


def _diverges_in_a_batch(solver: Solver) -> list[Law]:
    """A press that does not converge does not affect another in the same batch."""
    good = Scene(SPHERE, press([0.5 * MM]), PAD)
    bad = Scene(named("prism"), press([3.4 * MM]), PAD)
    numerics = Fem(spacing=1 * MM, newton_max=20, halvings=0, step_travel=1.0)
    (alone,) = solver.outcomes([good], numerics)
    beside, rejected = solver.outcomes([good, bad], numerics)
    if isinstance(alone, SimulationDiverged) or isinstance(beside, SimulationDiverged):
        return [at_least("the good press solved", 0, 1)]
    if not isinstance(rejected, SimulationDiverged):
        return [at_least("the bad press refused", 0, 1)]
    return [*alike(alone, beside), *evidence(rejected)]


CASES: dict[str, Case] = {
    case.__name__.strip("_").replace("_", "-"): case
    for case in (
        _not_a_number, _infinite, _below_zero, _millimetres_for_metres, _phases_without_time,
        _numerics_not_a_number, _unlike_bodies_in_a_batch, _one_newton_iteration, _out_of_reach,
        _diverges_in_a_batch,
    )
}  # fmt: skip
