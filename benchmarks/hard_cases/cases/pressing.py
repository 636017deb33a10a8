"""Material and depth: nearly incompressible to cork, soft to stiff; large strain, domes."""

from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.hard_cases import laws as law
from benchmarks.hard_cases.bodies import DOME, GEL, MM, SMALL, ball, down, even
from benchmarks.hard_cases.laws import Laws, push
from benchmarks.hard_cases.solver import Case, Solver, by_hand, case
from sim.errors import SimulationDiverged
from sim.indenters import NAMES, named, shapes
from sim.result import Result
from sim.scene import Motion, Scene

PRESS = down(0.5, 1.0)
MODULI = (1e4, 1e5, 1e6, 1e7)
PALM_SPHERE = shapes.sphere(8 * MM)
PALM_PRESS = even(4.5, 9)
SLAB = replace(DOME, dome_radius=None)
RISES = "force rises with nu"


def _poisson(*values: float, motion: Motion = PRESS) -> list[Scene]:
    return [ball(motion, replace(GEL, poisson=value)) for value in values]


@case(*_poisson(0.3, 0.45), det_f=0.35)
def poisson_0_3(*both: Result) -> Laws:
    """At nu 0.3 the layer is softer than at 0.45: a compressible foam, pressed 1 mm of 4."""
    yield law.rises(RISES, law.ends(both))


def _stiffens(says: str, *values: float, **numerics: Any) -> Case:
    """Assert that the force rises with nu, and only as that of elements without locking.

    A bonded layer stiffens by 7 to 8 %, on this mesh and on fine ones (1.5 mm deep: 2.093 N after
    1.956 N); elements with locking by 33 % at nu 0.49 and by a factor of 17 at 0.4999.
    """

    @case(*_poisson(0.45, *values), says=says, **numerics)
    def stiffens(*results: Result) -> Laws:
        force = law.ends(results)
        yield law.rises(RISES, force)
        yield law.at_most("stiffening since nu 0.45", force[-1] / force[0], 1.12)

    return stiffens


poisson_0_49 = _stiffens("At nu 0.49 the force rises by a few percent; elements do not lock.", 0.49)
poisson_0_499 = _stiffens("At nu 0.499 the force still rises by a few percent only.", 0.49, 0.499)
poisson_0_4999 = _stiffens(
    "At nu 0.4999, with a bulk modulus 1700 times the modulus, nothing locks or diverges.",
    0.499,
    0.4999,
    precision="float64",
)


@case(
    ball(PRESS, replace(SMALL, poisson=0.4999)),
    variants=({"precision": "auto"}, {"precision": "float64"}),
    spacing=4 / 3 * MM,
)
def poisson_0_4999_by_itself(own: Result, exact: Result) -> Laws:
    """At nu 0.4999 the solver automatically chooses the required precision."""
    yield law.same_force("auto against float64", own, exact)


# A light press, because at depth the resistance of cork to complete crushing dominates.
@case(*_poisson(0.0, 0.2, motion=down(0.2, 1.0)), det_f=0.2)
def poisson_zero(cork: Result, foam: Result) -> Laws:
    """Cork, nu 0: softer than foam at nu 0.2 in a light press, and hardly bulging."""
    yield law.rises(RISES, [push(cork)[1], push(foam)[1]])
    # Compressed cork does not swell; only rotation at large strain lifts the skin. At nu 0.45 it
    # rises by 0.03 of the depth.
    yield law.at_most("bulge / depth", cork.surface[-1, ..., 2].max() / MM, 0.02)


@case(*(ball(PRESS, replace(GEL, modulus=value)) for value in MODULI))
def modulus_1e4_to_1e7(*results: Result) -> Laws:
    """From jelly (1e4 Pa) to hard rubber (1e7 Pa), force over modulus is constant."""
    ratios = [result.force / value for result, value in zip(results, MODULI, strict=True)]
    # The solver works in units of the modulus: only the last digit of float32 differs.
    spread = max(law.difference(ratios[0], ratio) for ratio in ratios)
    yield law.at_most("spread of F / E", spread, 1e-5)


@case(ball(even(2.5, 25)))
def sphere_2_5_of_4_mm(result: Result) -> Laws:
    """A sphere 2.5 mm into 4 mm: 60 % strain under the tip, and all work is stored."""
    # Trapezoid rule over 25 steps of a force that grows as depth^2 or faster.
    yield law.conserves(result, 5e-3)
    yield law.deeper(result)
    yield law.rises("stiffness rises with depth", np.diff(push(result)))


@case(ball(even(3.6, 6)), det_f=0.1)
def sphere_3_6_of_4_mm(result: Result) -> Laws:
    """A sphere 3.6 mm into 4 mm, the deepest allowed press, keeps det F above its lower limit."""
    yield law.deeper(result)


@case(Scene(PALM_SPHERE, PALM_PRESS, DOME), spacing=2 * MM)
def dome_4_5_mm(result: Result) -> Laws:
    """4.5 mm into a soft dome (30 x 30 x 12 mm, radius 45 mm, 30 kPa), as into a TacPalm."""
    # 9 frames, each divided into at most 2 steps.
    yield law.conserves(result, 3e-2)
    yield law.deeper(result)


@case(Scene(PALM_SPHERE, down(2, 4.5), DOME), spacing=2 * MM)
def dome_is_symmetric(result: Result) -> Laws:
    """A dome pressed at its apex responds equally along x and y, and pushes straight up."""
    return [law.swapped(result, result, law.LAST_DIGITS), law.straight(result, 1e-4)]


@case(*(Scene(PALM_SPHERE, PALM_PRESS, body) for body in (DOME, SLAB)), spacing=2 * MM)
def thick_pad_4_5_mm(domed: Result, flat: Result) -> Laws:
    """4.5 mm into the same body without its dome takes more force than into the dome."""
    yield law.conserves(flat, 3e-2)
    yield law.rises("dome, then flat", law.ends([domed, flat]))


@case(Scene(named("prism"), down(1.5, 3, 4.5), DOME), det_f=0.1, spacing=2 * MM)
def dome_under_a_prism(result: Result) -> Laws:
    """A sharp-edged prism 4.5 mm into the dome: the edge cuts, nothing inverts."""
    yield law.deeper(result)


@case(Scene(named("wave"), even(1.5, 15)), det_f=0.3)
def wave_touches_in_two_places(result: Result) -> Laws:
    """Two ridges with a groove between: contacts open, join and never pull; work is stored."""
    return [law.conserves(result, 1e-2), law.deeper(result)]


@case(ball(even(1.5, 60)))
def force_is_continuous(result: Result) -> Laws:
    """Over 60 even steps to 1.5 mm the force has no jump when contact points join."""
    yield law.conserves(result, 2e-3)
    # Contact points join by eights out of about 60: a kink of 8/60 of a step's 2/60 of the force,
    # 0.4 %. A pressure that starts with a jump (as with stale contact) would give several percent.
    yield law.smooth(push(result), 0.01)


@by_hand
def named_indenters(solver: Solver) -> Laws:
    """Each of the 18 indenters, 0.8 mm deep: none inverts an element, all are in balance.

    On elements of 1 mm, half of them pass through the skin at an edge and are rejected.
    """
    results = []
    for name in NAMES:
        try:
            results.append(solver.one(Scene(named(name), down(0.4, 0.8))))
        except SimulationDiverged as diverged:
            yield from law.evidence(diverged)
    yield from law.validity_laws(*results)
    # The smallest force is the cone's, with a tip of 0.5 mm: 2 a d E* alone is 0.13 N.
    yield law.at_least("least force [N]", min(law.ends(results)), 0.1)
    yield law.at_least("indenters with a result", len(results), 8)
