"""Wrong input is rejected by name before a run; impossible numerics are rejected with evidence."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.hard_cases.case import Case, Solver
from benchmarks.hard_cases.cases.bodies import MM, PAD, SPHERE
from benchmarks.hard_cases.divergence import evidence
from benchmarks.hard_cases.laws import Law, at_least, at_most
from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.indenters import Part, named, shapes
from sim.scene import Body, Friction, Gravity, Inertia, Motion, Scene, Viscosity, press
from sim.tiers import simulate, simulate_many

# Sets one field of a scene to a number, which must be rejected.
Make = Callable[[float], object]


def _fields() -> Iterator[tuple[str, Make]]:
    """Yield every number of a scene: the name that its rejection must contain, and its setter."""
    for name in ("size_x", "size_y", "thickness", "modulus", "poisson", "dome_radius", "density"):
        yield name, _body(name)
    yield "coefficient", Friction
    yield "ratios", lambda value: Viscosity(ratios=(value,), times=(1.0,))
    yield "times", lambda value: Viscosity(ratios=(1.0,), times=(value,))
    yield "scale", Inertia
    for axis in range(3):
        yield f"acceleration[{axis}]", _gravity(axis)
        yield "tip[1]", _tip(axis)
    yield "time", lambda value: Motion(tip=((0.0, 0.0, 0.0),) * 2, time=(0.0, value))
    yield "time", lambda value: Motion(tip=((0.0, 0.0, 0.0),) * 2, time=(value, 1.0))
    yield "speed", lambda value: press([1 * MM], speed=value)
    yield "depths[0]", lambda value: press([value])
    yield "motion.at", lambda value: press([1 * MM], at=(value, 0.0))
    yield "shear", lambda value: press([1 * MM], shear=value)
    yield "tip", lambda value: press([1 * MM], shear=1 * MM, angle=value)
    yield "hold", lambda value: press([1 * MM], hold=value)
    yield "edge_radius", lambda value: named("prism", value)
    yield "narrowest", lambda value: replace(named("prism"), narrowest=value)
    yield "radius", shapes.sphere
    yield "radius", lambda value: shapes.flat_punch(value, 0.1 * MM)
    yield "half_angle", lambda value: shapes.cone(value, 0.3 * MM)
    yield "values", lambda value: Part("turned", "circle", (0.0, value, 1 * MM), "union")
    yield "values", lambda value: shapes.extruded((0, 0, 0, MM, 0, 0, MM, value, 0))
    yield "cosine", lambda value: Part("turned", "circle", (0, MM, MM), "union", cosine=value)
    yield "axis", lambda value: Part("turned", "circle", (0, MM, MM), "union", axis=(0.0, value))


def _body(name: str) -> Make:
    def make(value: float) -> Body:
        field: dict[str, Any] = {name: value}
        return replace(Body(), **field)

    return make


def _gravity(axis: int) -> Make:
    def make(value: float) -> Gravity:
        x, y, z = (value if axis == each else 0.0 for each in range(3))
        return Gravity((x, y, z))

    return make


def _tip(axis: int) -> Make:
    def make(value: float) -> Motion:
        x, y, z = (value if axis == each else 0.0 for each in range(3))
        return Motion(tip=((0.0, 0.0, 0.0), (x, y, z)), time=(0.0, 1.0))

    return make


def _refusals(fields: list[tuple[str, Make]], value: float) -> list[Law]:
    """Count the fields that accepted the value, and those rejected without their name."""
    accepted: list[str] = []
    nameless: list[str] = []
    for name, make in fields:
        try:
            make(value)
        except ValueError as error:
            if not isinstance(error, SceneError) or name not in str(error):
                nameless.append(name)
        else:
            accepted.append(name)
    tail = f" ({', '.join(accepted)})" if accepted else ""
    unnamed = f" ({', '.join(nameless)})" if nameless else ""
    return [
        at_most(f"fields that accepted {value:g}{tail}", len(accepted), 0),
        at_most(f"rejections of {value:g} that do not name the field{unnamed}", len(nameless), 0),
    ]


def not_a_number(solver: Solver) -> list[Law]:
    """NaN in any number of a scene is rejected by the field's name; no scene is created."""
    del solver
    return _refusals(list(_fields()), math.nan)


def infinite(solver: Solver) -> list[Law]:
    """Infinity likewise, except for the widest wall, where it means none."""
    del solver
    return _refusals([field for field in _fields() if field[0] != "narrowest"], math.inf)


def below_zero(solver: Solver) -> list[Law]:
    """Negative lengths, moduli, coefficients and times are rejected."""
    del solver
    signed = ("acceleration", "tip", "depths", "motion.at", "shear", "values", "axis", "cosine")
    return _refusals([field for field in _fields() if not field[0].startswith(signed)], -1.0)


def millimetres_for_metres(solver: Solver) -> list[Law]:
    """A body or a depth in millimetres is rejected; the message asks about the units."""
    del solver
    fields: list[tuple[str, Make]] = [
        ("size_x", lambda value: Body(size_x=20 * value, size_y=20 * value, thickness=4 * value)),
        ("are the units metres?", lambda value: Scene(SPHERE, press([1.5 * value]))),
        ("radius", lambda value: shapes.sphere(4 * value)),
    ]
    return _refusals(fields, 1.0)


def phases_without_time(solver: Solver) -> list[Law]:
    """Phases of zero length (the same depth twice, the same time twice) are rejected: no time."""
    del solver
    fields: list[tuple[str, Make]] = [
        ("depths", lambda value: press([1 * MM, 1 * MM + value])),
        ("time", lambda value: Motion(tip=((value, value, value),) * 2, time=(0.0, value))),
    ]
    return _refusals(fields, 0.0)


def numerics_not_a_number(solver: Solver) -> list[Law]:
    """NaN in the solver's settings is rejected by name, before a step is taken."""
    steps: list[float] = []
    tiny = Body(size_x=4 * MM, size_y=4 * MM, thickness=3 * MM)
    scene = Scene(SPHERE, press([0.2 * MM]), tiny)

    def with_field(name: str) -> Make:
        def make(value: float) -> object:
            changed: dict[str, Any] = {name: value}
            numerics = replace(Fem(spacing=1 * MM, halvings=0), **changed)
            return simulate(scene, numerics, device=solver.device, progress=steps.append)

        return make

    names = ("spacing", "tolerance", "penalty", "step_travel")
    laws = _refusals([(name, with_field(name)) for name in names], math.nan)
    return [*laws, at_most("steps that were taken", len(steps), 0)]


def unlike_bodies_in_a_batch(solver: Solver) -> list[Law]:
    """Bodies of different size, or effects, in one call: each gets the same result as alone."""
    base = Scene(SPHERE, press([0.5 * MM]), PAD)
    scenes = [
        base,
        replace(base, body=replace(PAD, thickness=5 * MM)),
        replace(base, body=replace(PAD, size_x=11 * MM)),
        replace(base, effects=replace(base.effects, friction=Friction(0.1))),
    ]
    numerics = Fem(spacing=1 * MM)
    batched = simulate_many(scenes, numerics, device=solver.device)
    laws = []
    for scene, result in zip(scenes, batched, strict=True):
        if isinstance(result, SimulationDiverged):
            return [at_least("solved", 0, 1)]
        alone = simulate(scene, numerics, device=solver.device)
        gap = float(np.abs(alone.force - result.force).max() / np.abs(alone.force).max())
        laws.append(at_most("difference from the result alone", gap, 0))
    return laws


def _gives_up(solver: Solver, scene: Scene, **numerics: object) -> list[Law]:
    try:
        solver.one(scene, **numerics)
    except SimulationDiverged as diverged:
        return [at_least("refused", 1, 1), *evidence(diverged)]
    return [at_least("refused", 0, 1)]


def one_newton_iteration(solver: Solver) -> list[Law]:
    """Limited to one Newton iteration and one halving, it reports this and its last state."""
    return _gives_up(solver, Scene(SPHERE, press([1 * MM]), PAD), newton_max=1, halvings=1)


def out_of_reach(solver: Solver) -> list[Law]:
    """A tolerance below float32's digits is rejected in float32, not ignored."""
    scene = Scene(SPHERE, press([1 * MM]), PAD)
    return _gives_up(solver, scene, precision="float32", tolerance=1e-9, halvings=2)


def diverges_in_a_batch(solver: Solver) -> list[Law]:
    """A press that does not converge does not affect another in the same batch."""
    good = Scene(SPHERE, press([0.5 * MM]), PAD)
    bad = Scene(named("prism"), press([3.4 * MM]), PAD)
    numerics = solver.numerics(newton_max=20, halvings=0, step_travel=1.0)
    alone = simulate(good, numerics, device=solver.device)
    beside, rejected = simulate_many([good, bad], numerics, device=solver.device)
    if isinstance(beside, SimulationDiverged):
        raise beside
    laws = [at_most("values that differ", int((alone.wrench != beside.wrench).sum()), 0)]
    if not isinstance(rejected, SimulationDiverged):
        return [*laws, at_least("the bad press refused", 0, 1)]
    return [*laws, at_least("the bad press refused", 1, 1), *evidence(rejected)]


CASES = (
    Case(not_a_number, seconds=0.1),
    Case(infinite, seconds=0.1),
    Case(below_zero, seconds=0.1),
    Case(millimetres_for_metres, seconds=0.1),
    Case(phases_without_time, seconds=0.1),
    Case(numerics_not_a_number, seconds=0.5),
    Case(unlike_bodies_in_a_batch, seconds=0.5),
    Case(one_newton_iteration, seconds=1),
    Case(out_of_reach, seconds=3),
    Case(diverges_in_a_batch, seconds=1),
)
