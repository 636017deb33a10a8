"""Depth: large strain on flat bodies and domes, and shapes with several contacts."""

from __future__ import annotations

import numpy as np

from benchmarks.hard_cases.case import Case, Solver
from benchmarks.hard_cases.cases.bodies import DOME, GEL, MM, SLAB, SPHERE
from benchmarks.hard_cases.divergence import evidence
from benchmarks.hard_cases.laws import (
    LAST_DIGITS,
    Law,
    at_least,
    at_most,
    conserves,
    push,
    rises,
    smooth,
    swapped,
    validity_laws,
)
from sim.errors import SimulationDiverged
from sim.indenters import NAMES, named, shapes
from sim.scene import Scene, press

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


CASES = (
    Case(sphere_2_5_of_4_mm, seconds=6),
    Case(sphere_3_6_of_4_mm, seconds=3),
    Case(dome_4_5_mm, seconds=2),
    Case(dome_is_symmetric, seconds=1),
    Case(thick_pad_4_5_mm, seconds=4),
    Case(dome_under_a_prism, seconds=4),
    Case(wave_touches_in_two_places, seconds=8),
    Case(force_is_continuous, seconds=10),
    Case(named_indenters, seconds=50),
)
