"""Wrong input: rejected by name before a run; impossible numerics are rejected with evidence."""

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any

from benchmarks.hard_cases.bodies import MM, PAD, ball, down
from benchmarks.hard_cases.laws import Laws, alike, at_least, at_most, evidence
from benchmarks.hard_cases.solver import Solver, by_hand, case, same_as_alone
from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.indenters import Part, named, shapes
from sim.result import Result
from sim.scene import Body, Friction, Gravity, Inertia, Motion, Scene, Viscosity, press

# A name that the error message must contain, and a function that sets one field of a scene.
Field = tuple[str, Callable[[Any], object]]
ORIGIN = (0.0, 0.0, 0.0)
CIRCLE = Part("turned", "circle", (0.0, MM, MM), "union")
# Every number of a scene.
FIELDS: list[Field] = [
    ("size_x", lambda value: Body(size_x=value)),
    ("size_y", lambda value: Body(size_y=value)),
    ("thickness", lambda value: Body(thickness=value)),
    ("modulus", lambda value: Body(modulus=value)),
    ("poisson", lambda value: Body(poisson=value)),
    ("dome_radius", lambda value: Body(dome_radius=value)),
    ("density", lambda value: Body(density=value)),
    ("coefficient", Friction),
    ("ratios", lambda value: Viscosity(ratios=(value,), times=(1.0,))),
    ("times", lambda value: Viscosity(ratios=(1.0,), times=(value,))),
    ("scale", Inertia),
    ("acceleration[0]", lambda value: Gravity((value, 0.0, 0.0))),
    ("acceleration[1]", lambda value: Gravity((0.0, value, 0.0))),
    ("acceleration[2]", lambda value: Gravity((0.0, 0.0, value))),
    ("tip[1]", lambda value: Motion((ORIGIN, (value, 0.0, 0.0)), (0.0, 1.0))),
    ("tip[1]", lambda value: Motion((ORIGIN, (0.0, value, 0.0)), (0.0, 1.0))),
    ("tip[1]", lambda value: Motion((ORIGIN, (0.0, 0.0, value)), (0.0, 1.0))),
    ("time", lambda value: Motion((ORIGIN, ORIGIN), (0.0, value))),
    ("time", lambda value: Motion((ORIGIN, ORIGIN), (value, 1.0))),
    ("speed", lambda value: down(1, speed=value)),
    ("depths[0]", lambda value: down(value)),
    ("motion.at", lambda value: down(1, at=(value, 0.0))),
    ("shear", lambda value: down(1, shear=value)),
    ("angle", lambda value: down(1, shear=1, angle=value)),
    ("hold", lambda value: down(1, hold=value)),
    ("edge_radius", lambda value: named("prism", value)),
    ("narrowest", lambda value: replace(named("prism"), narrowest=value)),
    ("radius", shapes.sphere),
    ("radius", lambda value: shapes.flat_punch(value, 0.1 * MM)),
    ("half_angle", lambda value: shapes.cone(value, 0.3 * MM)),
    ("values", lambda value: replace(CIRCLE, values=(0.0, value, MM))),
    ("values", lambda value: shapes.extruded((0, 0, 0, MM, 0, 0, MM, value, 0))),
    ("cosine", lambda value: replace(CIRCLE, cosine=value)),
    ("axis", lambda value: replace(CIRCLE, axis=(0.0, value))),
]
# Those that may be negative.
SIGNED = ("acceleration", "tip", "motion.at", "shear", "angle", "values", "axis", "cosine")


def _refusals(value: float, fields: Iterable[Field]) -> Laws:
    """Count the fields that accepted the value, and those rejected without their name."""
    accepted, nameless = [], []
    for name, make in fields:
        try:
            make(value)
            accepted.append(name)
        except ValueError as error:
            if not isinstance(error, SceneError) or name not in str(error):
                nameless.append(name)
    yield at_most(f"fields that accepted {value:g} {accepted or ''}", len(accepted), 0)
    yield at_most(f"rejections of {value:g} without a name {nameless or ''}", len(nameless), 0)


@by_hand
def not_a_number(_solver: Solver) -> Laws:
    """NaN in any number of a scene is rejected by the field's name; no scene is created."""
    return _refusals(math.nan, FIELDS)


@by_hand
def infinite(_solver: Solver) -> Laws:
    """Infinity likewise, except for the widest wall, where it means none."""
    return _refusals(math.inf, [field for field in FIELDS if field[0] != "narrowest"])


@by_hand
def below_zero(_solver: Solver) -> Laws:
    """Negative lengths, moduli, coefficients and times are rejected."""
    return _refusals(-1.0, [field for field in FIELDS if not field[0].startswith(SIGNED)])


@by_hand
def millimetres_for_metres(_solver: Solver) -> Laws:
    """A body or a depth in millimetres is rejected; the message asks about the units."""
    body: Field = ("size_x", lambda value: Body(20 * value, 20 * value, 4 * value))
    depth: Field = ("are the units metres?", lambda value: ball(press([1.5 * value])))
    radius: Field = ("radius", lambda value: shapes.sphere(4 * value))
    return _refusals(1.0, [body, depth, radius])


@by_hand
def phases_without_time(_solver: Solver) -> Laws:
    """Phases of zero length (the same depth twice, the same time twice) are rejected: no time."""
    depths: Field = ("depths", lambda value: press([1 * MM, 1 * MM + value]))
    time: Field = ("time", lambda value: Motion(((value, value, value),) * 2, (0.0, value)))
    return _refusals(0.0, [depths, time])


@by_hand
def numerics_not_a_number(solver: Solver) -> Laws:
    """NaN in the solver's settings is rejected by name, before a step is taken."""
    steps: list[float] = []
    scene = ball(down(0.2), Body(4 * MM, 4 * MM, 3 * MM))

    def solve(name: str, value: float) -> object:
        numerics = replace(Fem(spacing=1 * MM, halvings=0), **{name: value})  # type: ignore[arg-type]
        return solver.outcomes([scene], numerics, progress=steps.append)

    names = ("spacing", "tolerance", "penalty", "step_travel")
    yield from _refusals(math.nan, [(name, partial(solve, name)) for name in names])
    yield at_most("steps that were taken", len(steps), 0)


@by_hand
def unlike_bodies_in_a_batch(solver: Solver) -> Laws:
    """Bodies of different size, or effects, in one call: each gets the same result as alone."""
    motion = down(0.5)
    bodies = (PAD, replace(PAD, thickness=5 * MM), replace(PAD, size_x=11 * MM))
    rubbed = ball(motion, PAD, friction=Friction(0.1))
    return same_as_alone(solver, [*(ball(motion, body) for body in bodies), rubbed])


REFUSED = at_least("refused", 0, 1)
PRESS = ball(down(1), PAD)


@case(PRESS, or_none=True, newton_max=1, halvings=1)
def one_newton_iteration(_result: Result) -> Laws:
    """Limited to one Newton iteration and one halving, it reports this and its last state."""
    return [REFUSED]


@case(PRESS, or_none=True, precision="float32", tolerance=1e-9, halvings=2)
def out_of_reach(_result: Result) -> Laws:
    """A tolerance below float32's digits is rejected in float32, not ignored."""
    return [REFUSED]


@by_hand
def diverges_in_a_batch(solver: Solver) -> Laws:
    """A press that does not converge does not affect another in the same batch."""
    good, bad = ball(down(0.5), PAD), Scene(named("prism"), down(3.4), PAD)
    numerics = Fem(spacing=1 * MM, newton_max=20, halvings=0, step_travel=1.0)
    (alone,) = solver.outcomes([good], numerics)
    beside, rejected = solver.outcomes([good, bad], numerics)
    assert isinstance(alone, Result), "the good press was refused"
    assert isinstance(beside, Result), "the good press was refused beside the bad one"
    assert isinstance(rejected, SimulationDiverged), "the bad press was solved"
    return [alike(alone, beside), *evidence(rejected)]
