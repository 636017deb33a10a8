"""Material and depth: nearly incompressible to cork, soft to stiff; large strain, domes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.hard_cases.cases.bodies import DOME, GEL, MM, SLAB, SPHERE
from benchmarks.hard_cases.laws import (
    LAST_DIGITS,
    Law,
    at_least,
    at_most,
    conserves,
    difference,
    evidence,
    push,
    rises,
    same_force,
    smooth,
    swapped,
    validity_laws,
)
from benchmarks.hard_cases.solver import Solver
from sim.errors import SimulationDiverged
from sim.indenters import NAMES, named, shapes
from sim.scene import Body, Scene, press

PRESS = press([0.5 * MM, 1.0 * MM])
LIGHT = press([0.2 * MM, 1.0 * MM])
MIDDLE = 0.45


def _poisson(solver: Solver, values: tuple[float, ...], **numerics: Any) -> list[Law]:
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


PALM_SPHERE = shapes.sphere(8 * MM)
PALM_STEPS = [0.5 * MM * step for step in range(1, 10)]


def _even(depth: float, steps: int) -> list[float]:
    return [depth * step / steps for step in range(1, steps + 1)]


def sphere_2_5_of_4_mm(solver: Solver) -> list[Law]:
    """A sphere 2.5 mm into 4 mm: 60 % strain under the tip, and all work is stored."""
    result = solver.one(Scene(SPHERE, press(_even(2.5 * MM, 25))))
    return [
        *validity_laws(result, det_f=0.5),
        # Trapezoid rule over 25 steps of a force that grows as depth^2 or faster: error 1 / 25^2.
        conserves(result, 5e-3),
        rises("force rises with depth", push(result)),
        rises("stiffness rises with depth", np.diff(push(result))),
    ]


def sphere_3_6_of_4_mm(solver: Solver) -> list[Law]:
    """A sphere 3.6 mm into 4 mm, the deepest allowed press, keeps det F above its lower limit."""
    result = solver.one(Scene(SPHERE, press(_even(3.6 * MM, 6))))
    return [*validity_laws(result), rises("force rises with depth", push(result))]


def dome_4_5_mm(solver: Solver) -> list[Law]:
    """4.5 mm into a soft dome (30 x 30 x 12 mm, radius 45 mm, 30 kPa), as into a TacPalm."""
    result = solver.one(Scene(PALM_SPHERE, press(PALM_STEPS), DOME), spacing=2 * MM)
    return [
        *validity_laws(result, det_f=0.5),
        # 9 frames, each divided into at most 2 steps.
        conserves(result, 3e-2),
        rises("force rises with depth", push(result)),
    ]


def dome_is_symmetric(solver: Solver) -> list[Law]:
    """A dome pressed at its apex responds equally along x and y, and pushes straight up."""
    result = solver.one(Scene(PALM_SPHERE, press([2 * MM, 4.5 * MM]), DOME), spacing=2 * MM)
    aside = np.abs(result.force[:, :2]).max() / push(result).max()
    return [
        *validity_laws(result, det_f=0.5),
        swapped(result, result, LAST_DIGITS),
        at_most("force aside / force", aside, 1e-4),
    ]


def thick_pad_4_5_mm(solver: Solver) -> list[Law]:
    """4.5 mm into the same body without its dome takes more force than into the dome."""
    domed, flat = (
        solver.one(Scene(PALM_SPHERE, press(PALM_STEPS), body), spacing=2 * MM)
        for body in (DOME, SLAB)
    )
    return [
        *validity_laws(domed, flat, det_f=0.5),
        conserves(flat, 3e-2),
        rises("dome, then flat", [push(domed)[-1], push(flat)[-1]]),
    ]


def dome_under_a_prism(solver: Solver) -> list[Law]:
    """A sharp-edged prism 4.5 mm into the dome: the edge cuts, nothing inverts."""
    scene = Scene(named("prism"), press([1.5 * MM, 3 * MM, 4.5 * MM]), DOME)
    result = solver.one(scene, spacing=2 * MM)
    return [*validity_laws(result), rises("force rises with depth", push(result))]


def wave_touches_in_two_places(solver: Solver) -> list[Law]:
    """Two ridges with a groove between: contacts open, join and never pull; work is stored."""
    result = solver.one(Scene(named("wave"), press(_even(1.5 * MM, 15))))
    return [
        *validity_laws(result, det_f=0.3),
        conserves(result, 1e-2),
        rises("force", push(result)),
    ]


def force_is_continuous(solver: Solver) -> list[Law]:
    """Over 60 even steps to 1.5 mm the force has no jump when contact points join."""
    result = solver.one(Scene(SPHERE, press(_even(1.5 * MM, 60))))
    # Contact points join by eights out of about 60: a kink of 8/60 of a step's 2/60 of the force,
    # 0.4 %. A pressure that starts with a jump (as with stale contact) would give several percent.
    return [
        *validity_laws(result, det_f=0.5),
        conserves(result, 2e-3),
        smooth("largest second difference / largest force", push(result), 0.01),
    ]


def named_indenters(solver: Solver) -> list[Law]:
    """Each of the 18 indenters, 0.8 mm deep: none inverts an element, all are in balance.

    On elements of 1 mm, half of them pass through the skin at an edge and are rejected.
    """
    motion = press([0.4 * MM, 0.8 * MM])
    results, refusals = [], []
    for name in NAMES:
        try:
            results.append(solver.one(Scene(named(name), motion, GEL)))
        except SimulationDiverged as diverged:
            refusals += evidence(diverged)
    least = min(push(result)[-1] for result in results)
    # The smallest force is the cone's, with a tip of 0.5 mm: 2 a d E* alone is 0.13 N.
    return [
        *validity_laws(*results),
        *refusals,
        at_least("least force [N]", least, 0.1),
        at_least("indenters with a result", len(results), 8),
    ]
