"""Steps and starts: one huge step, a thousand tiny ones, loops, and unusual starts."""

from __future__ import annotations

import numpy as np

from benchmarks.hard_cases.cases.bodies import GEL, MAT, MM, PAD, SPHERE
from benchmarks.hard_cases.laws import (
    SAME,
    Law,
    at_least,
    at_most,
    difference,
    evidence,
    lets_go,
    push,
    rises,
    same_end,
    smooth,
    validity_laws,
)
from benchmarks.hard_cases.solver import Solver
from sim.errors import SimulationDiverged
from sim.indenters import Indenter, named
from sim.scene import Body, Motion, Scene, press, through

# Maximum step of the tip [m] that never limits.
UNLIMITED = 1.0
# Converged multipliers: by default 15 frames are 0.1 % closer to the solution than one.
CLOSED = {"penalty": 1000.0, "augmentations": 5}


# With rounder edges: under sharper ones the skin creases, or passes through coarse meshes.
ROUND_PRISM = named("prism", 0.8 * MM)


def one_huge_step(solver: Solver) -> list[Law]:
    """1.5 mm in a single step gives the force of 15 steps."""
    huge = solver.one(Scene(SPHERE, press([1.5 * MM])), step_travel=UNLIMITED, **CLOSED)
    slow = solver.one(Scene(SPHERE, press([0.1 * MM * step for step in range(1, 16)])), **CLOSED)
    return [*validity_laws(huge, slow, det_f=0.5), same_end("force", slow, huge, SAME)]


def thousand_tiny_steps(solver: Solver) -> list[Law]:
    """1,000 steps of 1 um to 1 mm do not drift: all work stored, no jump, as in one step."""
    body = Body(size_x=8 * MM, size_y=8 * MM)
    tiny = solver.one(
        Scene(SPHERE, press([1e-6 * step for step in range(1, 1001)]), body), spacing=4 / 3 * MM
    )
    huge = solver.one(Scene(SPHERE, press([1 * MM]), body), spacing=4 / 3 * MM)
    return [
        *validity_laws(tiny, huge, det_f=0.5),
        # The tolerance of the residual is 1e-4 of the force.
        at_most("work not stored", abs(tiny.quality.energy_gap[-1]), 1e-3),
        smooth("largest second difference / largest force", push(tiny), 1e-3),
        rises("force rises, within the tolerance", push(tiny), -1e-4),
        same_end("force", huge, tiny, SAME),
    ]


def reload_after_unload(solver: Solver) -> list[Law]:
    """Down, up and down again: without dissipation one curve, and zero force in between."""
    down = [0.25 * MM * step for step in range(1, 7)]
    up = down[-2::-1]
    result = solver.one(Scene(SPHERE, press([*down, *up, 0.0, *down])))
    force, count = push(result), len(down)
    first, back, again = force[1 : count + 1], force[count + 1 : 2 * count], force[-count:]
    return [
        *validity_laws(result, det_f=0.5),
        at_most("unloading against loading", difference(first[-2::-1], back), SAME),
        at_most("reloading against loading", difference(first, again), SAME),
        at_most("force between / largest", force[2 * count] / force.max(), 1e-6),
    ]


def there_and_back(solver: Solver) -> list[Law]:
    """A closed loop of 20 frames in depth and sideways returns all the work and lets go."""
    points = [(0.0, 0.0, 0.0)]
    points += [(0.0, 0.0, -0.15 * MM * step) for step in range(1, 9)]
    points += [(0.2 * MM * step, 0.0, -1.2 * MM) for step in range(1, 6)]
    points += [(1.0 * MM, 0.0, -1.2 * MM + 0.15 * MM * step) for step in range(1, 9)]
    result = solver.one(Scene(SPHERE, through(points, speed=10 * MM), MAT))
    # Trapezoid rule for work: its error during loading cancels during unloading.
    return [
        *validity_laws(result, det_f=0.5),
        at_most("work left in the loop", abs(result.quality.energy_gap[-1]), 5e-3),
        lets_go(result),
    ]


def two_ways_to_one_place(solver: Solver) -> list[Law]:
    """Down and then sideways, or diagonally: without friction only the final place matters."""
    top, end = (0.0, 0.0, 0.0), (0.8 * MM, 0.4 * MM, -1.2 * MM)
    corner = solver.one(
        Scene(SPHERE, through([top, (0.0, 0.0, -1.2 * MM), end], speed=10 * MM), MAT)
    )
    slant = solver.one(Scene(SPHERE, through([top, end], speed=10 * MM), MAT))
    return [*validity_laws(corner, slant, det_f=0.5), same_end("force", corner, slant, SAME)]


def starts_inside(solver: Solver) -> list[Law]:
    """An indenter that is 1.5 mm inside at frame 0 has the force of a slow press."""
    inside = solver.one(Scene(SPHERE, Motion(tip=((0.0, 0.0, -1.5 * MM),), time=(0.0,))))
    slow = solver.one(Scene(SPHERE, press([0.5 * MM, 1.0 * MM, 1.5 * MM])))
    return [*validity_laws(inside, slow, det_f=0.5), same_end("force", slow, inside, SAME)]


def _sunk(
    solver: Solver,
    indenter: Indenter,
    halves: int = 5,
    spacing: float | None = 1 * MM,
    **numerics: object,
) -> list[Law]:
    """Start `halves` half millimetres inside: the state of a slow press, or a valid rejection."""
    frames = press([0.5 * MM * step for step in range(1, halves + 1)])
    slow = solver.one(Scene(indenter, frames, MAT), spacing=spacing, **CLOSED)
    try:
        result = solver.one(_begun_inside(indenter, halves), spacing=spacing, **CLOSED, **numerics)
    except SimulationDiverged as diverged:
        return [*validity_laws(slow, det_f=0.05), *evidence(diverged)]
    return [*validity_laws(slow, result, det_f=0.05), same_end("force", slow, result, SAME)]


def _begun_inside(indenter: Indenter, halves: int) -> Scene:
    tip = (0.0, 0.0, -0.5 * MM * halves)
    return Scene(indenter, Motion(tip=(tip,), time=(0.0,)), MAT)


def prism_starts_deep_inside(solver: Solver) -> list[Law]:
    """A prism that is 1 mm inside at frame 0: the slow press's state, or none."""
    return _sunk(solver, ROUND_PRISM, halves=2, spacing=0.5 * MM)


def prism_where_the_skin_buckles(solver: Solver) -> list[Law]:
    """A prism 2.5 mm inside at frame 0, where the skin buckles either way: a valid state, or none.

    Without friction the skin under its edges creases from about 2 mm on, and there are several
    equilibria: 12.99, 13.97 and 15.46 N. The result depends on the path and on the last digit.
    """
    try:
        result = solver.one(_begun_inside(named("prism"), 5), **CLOSED)
    except SimulationDiverged as diverged:
        return evidence(diverged)
    return validity_laws(result, det_f=0.05)


def sphere_forced_in_at_once(solver: Solver) -> list[Law]:
    """A sphere 2.5 mm inside in one step of any length: the slow press's state, or none."""
    return _sunk(solver, SPHERE, step_travel=UNLIMITED)


def prism_forced_in_at_once(solver: Solver) -> list[Law]:
    """A prism 1 mm inside in one step: the correct state, or none."""
    return _sunk(solver, ROUND_PRISM, halves=2, spacing=0.5 * MM, step_travel=UNLIMITED)


def starts_at_touch(solver: Solver) -> list[Law]:
    """Exactly touching: zero force, and the following press is normal."""
    result = solver.one(Scene(SPHERE, Motion(tip=((0.0, 0.0, 0.0),), time=(0.0,)), PAD))
    return [
        at_most("force [N]", float(np.abs(result.wrench).max()), 1e-9),
        at_most("displacement [m]", float(np.abs(result.surface).max()), 1e-12),
        at_least("smallest det F", result.quality.det_f_min.min(), 0.999999),
    ]


def never_touches(solver: Solver) -> list[Law]:
    """A millimetre above the body, moving: zeros in every frame, no division by a zero force."""
    points = [(0.0, 0.0, 1 * MM), (2 * MM, 0.0, 1 * MM), (20 * MM, 0.0, -1 * MM)]
    result = solver.one(Scene(SPHERE, through(points, speed=10 * MM), PAD))
    quality = result.quality
    numbers = (quality.residual, quality.contact, quality.balance, quality.energy_gap)
    return [
        at_most("force [N]", float(np.abs(result.wrench).max()), 1e-9),
        at_most("displacement [m]", float(np.abs(result.surface).max()), 1e-12),
        at_most("quality", float(np.abs(np.stack(numbers)).max()), 1e-9),
    ]


def arrives_from_the_air(solver: Solver) -> list[Law]:
    """From 3 mm above to 1 mm deep in one frame: as if started at the surface."""
    air = solver.one(Scene(SPHERE, through([(0.0, 0.0, 3 * MM), (0.0, 0.0, -1 * MM)], speed=1.0)))
    near = solver.one(Scene(SPHERE, press([1 * MM])))
    return [*validity_laws(air, near, det_f=0.5), same_end("force", near, air, SAME)]


def arrives_from_the_side(solver: Solver) -> list[Law]:
    """Into the gel through its side face, 1 mm below the top: the same end as from above."""
    end = (3.5 * MM, 0.0, -1 * MM)
    side = solver.one(Scene(SPHERE, through([(14 * MM, 0.0, -1 * MM), end], speed=1.0), PAD))
    above = solver.one(Scene(SPHERE, press([1 * MM], at=(3.5 * MM, 0.0)), PAD))
    return [*validity_laws(side, above, det_f=0.3), same_end("force", above, side, 5e-3)]


def phases_without_travel(solver: Solver) -> list[Law]:
    """Held for five frames, elastic skin does not creep: the force is constant."""
    result = solver.one(Scene(SPHERE, press([1 * MM], hold=1.0, steps=5, speed=1 * MM / 0.1), GEL))
    held = result.force[5:]
    return [
        *validity_laws(result, det_f=0.5),
        at_most("change while held", difference(held[:1].repeat(len(held), axis=0), held), 1e-4),
    ]
