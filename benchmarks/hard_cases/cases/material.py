"""Material: nearly incompressible, compressible, soft and stiff."""

from __future__ import annotations

from dataclasses import replace

from benchmarks.hard_cases.case import Case, Solver
from benchmarks.hard_cases.cases.bodies import GEL, MM, SPHERE
from benchmarks.hard_cases.laws import (
    Law,
    at_most,
    difference,
    push,
    rises,
    same_force,
    validity_laws,
)
from sim.scene import Body, Scene, press

PRESS = press([0.5 * MM, 1.0 * MM])
LIGHT = press([0.2 * MM, 1.0 * MM])
MIDDLE = 0.45


def _poisson(solver: Solver, values: tuple[float, ...], **numerics: object) -> list[Law]:
    scenes = [Scene(SPHERE, PRESS, replace(GEL, poisson=value)) for value in (MIDDLE, *values)]
    middle, *others = solver.many(scenes, **numerics)
    force = [push(result)[-1] for result in (middle, *others)]
    return [
        *validity_laws(middle, *others, det_f=0.5),
        rises("force rises with nu", force),
        # A bonded layer stiffens by 7 to 8 %, on this mesh and on fine ones (1.5 mm deep: 2.093 N
        # after 1.956 N); elements with locking by 33 % at nu 0.49 and by a factor of 17 at 0.4999.
        at_most("stiffening since nu 0.45", force[-1] / force[0], 1.12),
    ]


def poisson_0_3(solver: Solver) -> list[Law]:
    """At nu 0.3 the layer is softer than at 0.45: a compressible foam, pressed 1 mm of 4."""
    soft, hard = solver.many(
        [Scene(SPHERE, PRESS, replace(GEL, poisson=value)) for value in (0.3, MIDDLE)]
    )
    return [
        *validity_laws(soft, hard, det_f=0.35),
        rises("force rises with nu", [push(soft)[-1], push(hard)[-1]]),
    ]


def poisson_0_49(solver: Solver) -> list[Law]:
    """At nu 0.49 the force rises by a few percent; elements do not lock."""
    return _poisson(solver, (0.49,))


def poisson_0_499(solver: Solver) -> list[Law]:
    """At nu 0.499 the force still rises by a few percent only."""
    return _poisson(solver, (0.49, 0.499))


def poisson_0_4999(solver: Solver) -> list[Law]:
    """At nu 0.4999, with a bulk modulus 1700 times the modulus, nothing locks or diverges."""
    return _poisson(solver, (0.499, 0.4999), precision="float64")


def poisson_0_4999_by_itself(solver: Solver) -> list[Law]:
    """At nu 0.4999 the solver automatically chooses the required precision."""
    body = Body(size_x=8 * MM, size_y=8 * MM, poisson=0.4999)
    chosen, exact = (
        solver.one(Scene(SPHERE, PRESS, body), spacing=4 / 3 * MM, precision=precision)
        for precision in ("auto", "float64")
    )
    return [
        *validity_laws(chosen, exact, det_f=0.5),
        same_force("auto against float64", chosen, exact, 5e-4),
    ]


def poisson_zero(solver: Solver) -> list[Law]:
    """Cork, nu 0: softer than foam at nu 0.2 in a light press, and hardly bulging."""
    cork, foam = solver.many(
        [Scene(SPHERE, LIGHT, replace(GEL, poisson=value)) for value in (0.0, 0.2)]
    )
    return [
        *validity_laws(cork, foam, det_f=0.2),
        # A light press, because at depth the resistance of cork to complete crushing dominates.
        rises("force rises with nu", [push(cork)[1], push(foam)[1]]),
        # Compressed cork does not swell; only rotation at large strain lifts the skin. At nu 0.45
        # it rises by 0.03 of the depth.
        at_most("bulge / depth", cork.surface[-1, ..., 2].max() / MM, 0.02),
    ]


def modulus_1e4_to_1e7(solver: Solver) -> list[Law]:
    """From jelly (1e4 Pa) to hard rubber (1e7 Pa), force over modulus is constant."""
    values = (1e4, 1e5, 1e6, 1e7)
    results = solver.many([Scene(SPHERE, PRESS, replace(GEL, modulus=value)) for value in values])
    ratios = [result.force / value for result, value in zip(results, values, strict=True)]
    # The solver works in units of the modulus: only the last digit of float32 differs.
    spread = max(difference(ratios[0], ratio) for ratio in ratios)
    return [*validity_laws(*results, det_f=0.5), at_most("spread of F / E", spread, 1e-5)]


CASES = (
    Case(poisson_0_3, seconds=1),
    Case(poisson_0_49, seconds=2),
    Case(poisson_0_499, seconds=5),
    Case(poisson_0_4999, seconds=20),
    Case(poisson_0_4999_by_itself, seconds=20),
    Case(poisson_zero, seconds=1),
    Case(modulus_1e4_to_1e7, seconds=3),
)
