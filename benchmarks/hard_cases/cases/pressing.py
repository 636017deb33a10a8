"""Material and depth: nearly incompressible to cork, soft to stiff; large strain, domes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.hard_cases import laws as law
from benchmarks.hard_cases.cases.bodies import DOME, GEL, MM, SLAB, ball, even
from benchmarks.hard_cases.laws import Law, push
from benchmarks.hard_cases.solver import Case, Solver, case
from sim.errors import SimulationDiverged
from sim.indenters import NAMES, named, shapes
from sim.result import Result
from sim.scene import Body, Motion, Scene, press

PRESS = press([0.5 * MM, 1.0 * MM])
DEEPER = "force rises with depth"
MODULI = (1e4, 1e5, 1e6, 1e7)
PALM_SPHERE = shapes.sphere(8 * MM)
PALM_PRESS = press([0.5 * MM * step for step in range(1, 10)])


def _poisson(*values: float, motion: Motion = PRESS) -> list[Scene]:
    return [ball(motion, replace(GEL, poisson=value)) for value in values]


def _stiffens(*results: Result) -> list[Law]:
    """Return the law that the force rises with nu, and only as that of elements without locking.

    A bonded layer stiffens by 7 to 8 %, on this mesh and on fine ones (1.5 mm deep: 2.093 N after
    1.956 N); elements with locking by 33 % at nu 0.49 and by a factor of 17 at 0.4999.
    """
    force = [push(result)[-1] for result in results]
    return [
        law.rises("force rises with nu", force),
        law.at_most("stiffening since nu 0.45", force[-1] / force[0], 1.12),
    ]


def _ratios_agree(*results: Result) -> list[Law]:
    ratios = [result.force / value for result, value in zip(results, MODULI, strict=True)]
    # The solver works in units of the modulus: only the last digit of float32 differs.
    spread = max(law.difference(ratios[0], ratio) for ratio in ratios)
    return [law.at_most("spread of F / E", spread, 1e-5)]


def _named_indenters(solver: Solver) -> list[Law]:
    """Each of the 18 indenters, 0.8 mm deep: none inverts an element, all are in balance.

    On elements of 1 mm, half of them pass through the skin at an edge and are rejected.
    """
    results, refusals = [], []
    for name in NAMES:
        try:
            results.append(solver.one(Scene(named(name), press([0.4 * MM, 0.8 * MM]))))
        except SimulationDiverged as diverged:
            refusals += law.evidence(diverged)
    least = min(push(result)[-1] for result in results)
    # The smallest force is the cone's, with a tip of 0.5 mm: 2 a d E* alone is 0.13 N.
    return [
        *law.validity_laws(*results),
        *refusals,
        law.at_least("least force [N]", least, 0.1),
        law.at_least("indenters with a result", len(results), 8),
    ]


CASES: dict[str, Case] = {
    "poisson-0-3": case(
        "At nu 0.3 the layer is softer than at 0.45: a compressible foam, pressed 1 mm of 4.",
        _poisson(0.3, 0.45),
        lambda *both: [law.rises("force rises with nu", [push(each)[-1] for each in both])],
        det_f=0.35,
    ),
    "poisson-0-49": case(
        "At nu 0.49 the force rises by a few percent; elements do not lock.",
        _poisson(0.45, 0.49),
        _stiffens,
    ),
    "poisson-0-499": case(
        "At nu 0.499 the force still rises by a few percent only.",
        _poisson(0.45, 0.49, 0.499),
        _stiffens,
    ),
    "poisson-0-4999": case(
        "At nu 0.4999, with a bulk modulus 1700 times the modulus, nothing locks or diverges.",
        _poisson(0.45, 0.499, 0.4999),
        _stiffens,
        precision="float64",
    ),
    "poisson-0-4999-by-itself": case(
        "At nu 0.4999 the solver automatically chooses the required precision.",
        [ball(PRESS, Body(size_x=8 * MM, size_y=8 * MM, poisson=0.4999))],
        lambda own, exact: [law.same_force("auto against float64", own, exact, 5e-4)],
        variants=({"precision": "auto"}, {"precision": "float64"}),
        spacing=4 / 3 * MM,
    ),
    "poisson-zero": case(
        "Cork, nu 0: softer than foam at nu 0.2 in a light press, and hardly bulging.",
        # A light press, because at depth the resistance of cork to complete crushing dominates.
        _poisson(0.0, 0.2, motion=press([0.2 * MM, 1.0 * MM])),
        lambda cork, foam: [
            law.rises("force rises with nu", [push(cork)[1], push(foam)[1]]),
            # Compressed cork does not swell; only rotation at large strain lifts the skin. At nu
            # 0.45 it rises by 0.03 of the depth.
            law.at_most("bulge / depth", cork.surface[-1, ..., 2].max() / MM, 0.02),
        ],
        det_f=0.2,
    ),
    "modulus-1e4-to-1e7": case(
        "From jelly (1e4 Pa) to hard rubber (1e7 Pa), force over modulus is constant.",
        [ball(PRESS, replace(GEL, modulus=value)) for value in MODULI],
        _ratios_agree,
    ),
    "sphere-2-5-of-4-mm": case(
        "A sphere 2.5 mm into 4 mm: 60 % strain under the tip, and all work is stored.",
        [ball(press(even(2.5 * MM, 25)))],
        lambda result: [
            # Trapezoid rule over 25 steps of a force that grows as depth^2 or faster.
            law.conserves(result, 5e-3),
            law.rises(DEEPER, push(result)),
            law.rises("stiffness rises with depth", np.diff(push(result))),
        ],
    ),
    "sphere-3-6-of-4-mm": case(
        "A sphere 3.6 mm into 4 mm, the deepest allowed press, keeps det F above its lower limit.",
        [ball(press(even(3.6 * MM, 6)))],
        lambda result: [law.rises(DEEPER, push(result))],
        det_f=0.1,
    ),
    "dome-4-5-mm": case(
        "4.5 mm into a soft dome (30 x 30 x 12 mm, radius 45 mm, 30 kPa), as into a TacPalm.",
        [Scene(PALM_SPHERE, PALM_PRESS, DOME)],
        # 9 frames, each divided into at most 2 steps.
        lambda result: [law.conserves(result, 3e-2), law.rises(DEEPER, push(result))],
        spacing=2 * MM,
    ),
    "dome-is-symmetric": case(
        "A dome pressed at its apex responds equally along x and y, and pushes straight up.",
        [Scene(PALM_SPHERE, press([2 * MM, 4.5 * MM]), DOME)],
        lambda result: [law.swapped(result, result, law.LAST_DIGITS), law.straight(result, 1e-4)],
        spacing=2 * MM,
    ),
    "thick-pad-4-5-mm": case(
        "4.5 mm into the same body without its dome takes more force than into the dome.",
        [Scene(PALM_SPHERE, PALM_PRESS, body) for body in (DOME, SLAB)],
        lambda domed, flat: [
            law.conserves(flat, 3e-2),
            law.rises("dome, then flat", [push(domed)[-1], push(flat)[-1]]),
        ],
        spacing=2 * MM,
    ),
    "dome-under-a-prism": case(
        "A sharp-edged prism 4.5 mm into the dome: the edge cuts, nothing inverts.",
        [Scene(named("prism"), press([1.5 * MM, 3 * MM, 4.5 * MM]), DOME)],
        lambda result: [law.rises(DEEPER, push(result))],
        det_f=0.1,
        spacing=2 * MM,
    ),
    "wave-touches-in-two-places": case(
        "Two ridges with a groove between: contacts open, join and never pull; work is stored.",
        [Scene(named("wave"), press(even(1.5 * MM, 15)))],
        lambda result: [law.conserves(result, 1e-2), law.rises("force", push(result))],
        det_f=0.3,
    ),
    "force-is-continuous": case(
        "Over 60 even steps to 1.5 mm the force has no jump when contact points join.",
        [ball(press(even(1.5 * MM, 60)))],
        # Contact points join by eights out of about 60: a kink of 8/60 of a step's 2/60 of the
        # force, 0.4 %. A pressure that starts with a jump (as with stale contact) would give
        # several percent.
        lambda result: [law.conserves(result, 2e-3), law.smooth(law.KINK, push(result), 0.01)],
    ),
    "named-indenters": _named_indenters,
}
