"""Steps and starts: one huge step, a thousand tiny ones, loops, and unusual starts."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.hard_cases import laws as law
from benchmarks.hard_cases.cases.bodies import GEL, MAT, MM, PAD, SPHERE, ball, even, way
from benchmarks.hard_cases.laws import Law, push
from benchmarks.hard_cases.solver import Case, Solver, case
from sim.errors import SimulationDiverged
from sim.indenters import Indenter, named
from sim.result import Result
from sim.scene import Body, Motion, Scene, press

# Maximum step of the tip [m] that never limits.
UNLIMITED = 1.0
# Converged multipliers: by default 15 frames are 0.1 % closer to the solution than one.
CLOSED: dict[str, Any] = {"penalty": 1000.0, "augmentations": 5}
# With rounder edges: under sharper ones the skin creases, or passes through coarse meshes.
ROUND_PRISM = named("prism", 0.8 * MM)
SMALL = Body(size_x=8 * MM, size_y=8 * MM)
DOWN = [0.25 * MM * step for step in range(1, 7)]
# Down, aside and up in 20 frames [mm].
DETOUR = [(0.0, 0.0, -0.15 * step) for step in range(9)]
DETOUR += [(0.2 * step, 0.0, -1.2) for step in range(1, 6)]
DETOUR += [(1.0, 0.0, -1.2 + 0.15 * step) for step in range(1, 9)]


def _begun(z: float) -> Motion:
    """Return a motion with one frame, at this height."""
    return Motion(tip=((0.0, 0.0, z),), time=(0.0,))


def _same_end(
    says: str,
    one: Motion,
    other: Motion,
    body: Body = GEL,
    limit: float = law.SAME,
    det_f: float = 0.5,
    **numerics: Any,
) -> Case:
    """Return the case that two ways lead to the same force."""
    return case(
        says,
        [ball(motion, body) for motion in (one, other)],
        lambda first, second: [law.same_end("force", second, first, limit)],
        det_f=det_f,
        **numerics,
    )


def _stays_on_its_way(tiny: Result, huge: Result) -> list[Law]:
    return [
        # The tolerance of the residual is 1e-4 of the force.
        law.at_most("work not stored", abs(tiny.quality.energy_gap[-1]), 1e-3),
        law.smooth(law.KINK, push(tiny), 1e-3),
        law.rises("force rises, within the tolerance", push(tiny), -1e-4),
        law.same_end("force", huge, tiny, law.SAME),
    ]


def _one_curve(result: Result) -> list[Law]:
    force, count = push(result), len(DOWN)
    first, back, again = force[1 : count + 1], force[count + 1 : 2 * count], force[-count:]
    return [
        law.at_most("unloading against loading", law.difference(first[-2::-1], back), law.SAME),
        law.at_most("reloading against loading", law.difference(first, again), law.SAME),
        law.at_most("force between / largest", force[2 * count] / force.max(), 1e-6),
    ]


def _sunk(says: str, indenter: Indenter, halves: int, spacing: float, **numerics: Any) -> Case:
    """Start `halves` half millimetres inside: the state of a slow press, or a valid rejection."""
    slow = Scene(indenter, press([0.5 * MM * step for step in range(1, halves + 1)]), MAT)
    sunk = Scene(indenter, _begun(-0.5 * MM * halves), MAT)

    def laws(solver: Solver) -> list[Law]:
        pressed = solver.one(slow, spacing=spacing, **CLOSED)
        try:
            result = solver.one(sunk, spacing=spacing, **CLOSED, **numerics)
        except SimulationDiverged as diverged:
            return [*law.validity_laws(pressed, det_f=0.05), *law.evidence(diverged)]
        valid = law.validity_laws(pressed, result, det_f=0.05)
        return [*valid, law.same_end("force", pressed, result, law.SAME)]

    laws.__doc__ = says
    return laws


def _prism_where_the_skin_buckles(solver: Solver) -> list[Law]:
    """A prism 2.5 mm inside at frame 0, where the skin buckles either way: a valid state, or none.

    Without friction the skin under its edges creases from about 2 mm on, and there are several
    equilibria: 12.99, 13.97 and 15.46 N. The result depends on the path and on the last digit.
    """
    try:
        result = solver.one(Scene(named("prism"), _begun(-2.5 * MM), MAT), **CLOSED)
    except SimulationDiverged as diverged:
        return law.evidence(diverged)
    return law.validity_laws(result, det_f=0.05)


def _nothing_happens(result: Result) -> list[Law]:
    return [
        law.at_most("force [N]", float(np.abs(result.wrench).max()), 1e-9),
        law.at_most("displacement [m]", float(np.abs(result.surface).max()), 1e-12),
    ]


def _zeros(result: Result) -> list[Law]:
    quality = result.quality
    numbers = (quality.residual, quality.contact, quality.balance, quality.energy_gap)
    return [
        *_nothing_happens(result),
        law.at_most("quality", float(np.abs(np.stack(numbers)).max()), 1e-9),
    ]


def _does_not_creep(result: Result) -> list[Law]:
    held = result.force[5:]
    change = law.difference(held[:1].repeat(len(held), axis=0), held)
    return [law.at_most("change while held", change, 1e-4)]


CASES: dict[str, Case] = {
    "one-huge-step": _same_end(
        "1.5 mm in a single step gives the force of 15 steps.",
        press([1.5 * MM]),
        press(even(1.5 * MM, 15)),
        step_travel=UNLIMITED,
        **CLOSED,
    ),
    "thousand-tiny-steps": case(
        "1,000 steps of 1 um to 1 mm do not drift: all work stored, no jump, as in one step.",
        [ball(press(even(1 * MM, steps)), SMALL) for steps in (1000, 1)],
        _stays_on_its_way,
        spacing=4 / 3 * MM,
    ),
    "reload-after-unload": case(
        "Down, up and down again: without dissipation one curve, and zero force in between.",
        [ball(press([*DOWN, *DOWN[-2::-1], 0.0, *DOWN]))],
        _one_curve,
    ),
    "there-and-back": case(
        "A closed loop of 20 frames in depth and sideways returns all the work and lets go.",
        [ball(way(*DETOUR), MAT)],
        lambda result: [
            # Trapezoid rule for work: its error during loading cancels during unloading.
            law.at_most("work left in the loop", abs(result.quality.energy_gap[-1]), 5e-3),
            law.lets_go(result),
        ],
    ),
    "two-ways-to-one-place": _same_end(
        "Down and then sideways, or diagonally: without friction only the final place matters.",
        way((0, 0, 0), (0.8, 0.4, -1.2)),
        way((0, 0, 0), (0, 0, -1.2), (0.8, 0.4, -1.2)),
        MAT,
    ),
    "starts-inside": _same_end(
        "An indenter that is 1.5 mm inside at frame 0 has the force of a slow press.",
        _begun(-1.5 * MM),
        press([0.5 * MM, 1.0 * MM, 1.5 * MM]),
    ),
    "prism-starts-deep-inside": _sunk(
        "A prism that is 1 mm inside at frame 0: the slow press's state, or none.",
        ROUND_PRISM,
        2,
        0.5 * MM,
    ),
    "prism-where-the-skin-buckles": _prism_where_the_skin_buckles,
    "sphere-forced-in-at-once": _sunk(
        "A sphere 2.5 mm inside in one step of any length: the slow press's state, or none.",
        SPHERE,
        5,
        1 * MM,
        step_travel=UNLIMITED,
    ),
    "prism-forced-in-at-once": _sunk(
        "A prism 1 mm inside in one step: the correct state, or none.",
        ROUND_PRISM,
        2,
        0.5 * MM,
        step_travel=UNLIMITED,
    ),
    "starts-at-touch": case(
        "Exactly touching: zero force, and the following press is normal.",
        [ball(_begun(0.0), PAD)],
        lambda result: [
            *_nothing_happens(result),
            law.at_least("smallest det F", result.quality.det_f_min.min(), 0.999999),
        ],
        det_f=None,
    ),
    "never-touches": case(
        "A millimetre above the body, moving: zeros in every frame, no division by a zero force.",
        [ball(way((0, 0, 1), (2, 0, 1), (20, 0, -1)), PAD)],
        _zeros,
        det_f=None,
    ),
    "arrives-from-the-air": _same_end(
        "From 3 mm above to 1 mm deep in one frame: as if started at the surface.",
        way((0, 0, 3), (0, 0, -1), speed=1.0),
        press([1 * MM]),
    ),
    "arrives-from-the-side": _same_end(
        "Into the gel through its side face, 1 mm below the top: the same end as from above.",
        way((14, 0, -1), (3.5, 0, -1), speed=1.0),
        press([1 * MM], at=(3.5 * MM, 0.0)),
        PAD,
        limit=5e-3,
        det_f=0.3,
    ),
    "phases-without-travel": case(
        "Held for five frames, elastic skin does not creep: the force is constant.",
        [ball(press([1 * MM], hold=1.0, steps=5, speed=1 * MM / 0.1))],
        _does_not_creep,
    ),
}
