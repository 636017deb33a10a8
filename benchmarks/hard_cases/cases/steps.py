"""Steps and starts: one huge step, a thousand tiny ones, loops, and unusual starts."""

from typing import Any

import numpy as np

from benchmarks.hard_cases import laws as law
from benchmarks.hard_cases.bodies import MAT, MM, PAD, SMALL, SPHERE, ball, begun, down, even, way
from benchmarks.hard_cases.laws import Laws, push
from benchmarks.hard_cases.solver import Solver, by_hand, case
from sim.errors import SimulationDiverged
from sim.indenters import Indenter, named
from sim.result import Result
from sim.scene import Scene

# Maximum step of the tip [m] that never limits.
UNLIMITED = 1.0
# Converged multipliers: by default 15 frames are 0.1 % closer to the solution than one.
CLOSED: dict[str, Any] = {"penalty": 1000.0, "augmentations": 5}
# With rounder edges: under sharper ones the skin creases, or passes through coarse meshes.
ROUND_PRISM = named("prism", 0.8 * MM)
LOADING = [0.25 * step for step in range(1, 7)]
# Down, aside and up in 20 frames [mm].
DETOUR = [(0.0, 0.0, -0.15 * step) for step in range(9)]
DETOUR += [(0.2 * step, 0.0, -1.2) for step in range(1, 6)]
DETOUR += [(1.0, 0.0, -1.2 + 0.15 * step) for step in range(1, 9)]


@case(ball(down(1.5)), ball(even(1.5, 15)), step_travel=UNLIMITED, **CLOSED)
def one_huge_step(one: Result, many: Result) -> Laws:
    """1.5 mm in a single step gives the force of 15 steps."""
    yield law.same_end(many, one)


@case(*(ball(even(1, steps), SMALL) for steps in (1000, 1)), spacing=4 / 3 * MM)
def thousand_tiny_steps(tiny: Result, huge: Result) -> Laws:
    """1,000 steps of 1 um to 1 mm do not drift: all work stored, no jump, as in one step."""
    # The tolerance of the residual is 1e-4 of the force.
    yield law.conserves(tiny, 1e-3, "work not stored")
    yield law.smooth(push(tiny), 1e-3)
    yield law.rises("force rises, within the tolerance", push(tiny), -1e-4)
    yield law.same_end(huge, tiny)


@case(ball(down(*LOADING, *LOADING[-2::-1], 0.0, *LOADING)))
def reload_after_unload(result: Result) -> Laws:
    """Down, up and down again: without dissipation one curve, and zero force in between."""
    force, count = push(result), len(LOADING)
    first, back, again = force[1 : count + 1], force[count + 1 : 2 * count], force[-count:]
    yield law.at_most("unloading against loading", law.difference(first[-2::-1], back), law.SAME)
    yield law.at_most("reloading against loading", law.difference(first, again), law.SAME)
    yield law.at_most("force between / largest", force[2 * count] / force.max(), 1e-6)


@case(ball(way(*DETOUR), MAT))
def there_and_back(result: Result) -> Laws:
    """A closed loop of 20 frames in depth and sideways returns all the work and lets go."""
    # Trapezoid rule for work: its error during loading cancels during unloading.
    yield law.conserves(result, 5e-3, "work left in the loop")


@case(*(ball(way((0, 0, 0), *then, (0.8, 0.4, -1.2)), MAT) for then in ([], [(0, 0, -1.2)])))
def two_ways_to_one_place(diagonal: Result, sideways: Result) -> Laws:
    """Down and then sideways, or diagonally: without friction only the final place matters."""
    yield law.same_end(sideways, diagonal)


@case(ball(begun(-1.5)), ball(down(0.5, 1.0, 1.5)))
def starts_inside(inside: Result, pressed: Result) -> Laws:
    """An indenter that is 1.5 mm inside at frame 0 has the force of a slow press."""
    yield law.same_end(pressed, inside)


def _sunk(solver: Solver, indenter: Indenter, halves: int, spacing: float, **numerics: Any) -> Laws:
    """Start `halves` half millimetres inside: the state of a slow press, or a valid rejection."""
    slow = Scene(indenter, even(0.5 * halves, halves), MAT)
    pressed = solver.one(slow, spacing=spacing, **CLOSED)
    start = Scene(indenter, begun(-0.5 * halves), MAT)
    try:
        sunk = solver.one(start, spacing=spacing, **CLOSED, **numerics)
    except SimulationDiverged as diverged:
        return [*law.validity_laws(pressed, det_f=0.05), *law.evidence(diverged)]
    return [*law.validity_laws(pressed, sunk, det_f=0.05), law.same_end(pressed, sunk)]


@by_hand
def prism_starts_deep_inside(solver: Solver) -> Laws:
    """A prism that is 1 mm inside at frame 0: the slow press's state, or none."""
    return _sunk(solver, ROUND_PRISM, 2, 0.5 * MM)


@case(Scene(named("prism"), begun(-2.5), MAT), det_f=0.05, or_none=True, **CLOSED)
def prism_where_the_skin_buckles(_result: Result) -> Laws:
    """A prism 2.5 mm inside at frame 0, where the skin buckles either way: a valid state, or none.

    Without friction the skin under its edges creases from about 2 mm on, and there are several
    equilibria: 12.99, 13.97 and 15.46 N. The result depends on the path and on the last digit.
    """
    return []


@by_hand
def sphere_forced_in_at_once(solver: Solver) -> Laws:
    """A sphere 2.5 mm inside in one step of any length: the slow press's state, or none."""
    return _sunk(solver, SPHERE, 5, 1 * MM, step_travel=UNLIMITED)


@by_hand
def prism_forced_in_at_once(solver: Solver) -> Laws:
    """A prism 1 mm inside in one step: the correct state, or none."""
    return _sunk(solver, ROUND_PRISM, 2, 0.5 * MM, step_travel=UNLIMITED)


def _nothing_happens(result: Result) -> Laws:
    yield law.at_most("force [N]", np.abs(result.wrench).max(), 1e-9)
    yield law.at_most("displacement [m]", np.abs(result.surface).max(), 1e-12)


@case(ball(begun(0.0), PAD), det_f=0.999999)
def starts_at_touch(result: Result) -> Laws:
    """Exactly touching: zero force, and the following press is normal."""
    return _nothing_happens(result)


@case(ball(way((0, 0, 1), (2, 0, 1), (20, 0, -1)), PAD))
def never_touches(result: Result) -> Laws:
    """A millimetre above the body, moving: zeros in every frame, no division by a zero force."""
    yield from _nothing_happens(result)
    quality = result.quality
    numbers = [quality.residual, quality.contact, quality.balance, quality.energy_gap]
    yield law.at_most("quality", np.abs(numbers).max(), 1e-9)


@case(ball(way((0, 0, 3), (0, 0, -1), speed=1.0)), ball(down(1)))
def arrives_from_the_air(arrived: Result, pressed: Result) -> Laws:
    """From 3 mm above to 1 mm deep in one frame: as if started at the surface."""
    yield law.same_end(pressed, arrived)


@case(
    ball(way((14, 0, -1), (3.5, 0, -1), speed=1.0), PAD), ball(down(1, at=(3.5, 0)), PAD), det_f=0.3
)
def arrives_from_the_side(arrived: Result, pressed: Result) -> Laws:
    """Into the gel through its side face, 1 mm below the top: the same end as from above."""
    yield law.same_end(pressed, arrived, 5e-3)


@case(ball(down(1, hold=1.0, steps=5)))
def phases_without_travel(result: Result) -> Laws:
    """Held for five frames, elastic skin does not creep: the force is constant."""
    first, *held = result.force[5:]
    change = max(law.difference(first, force) for force in held)
    yield law.at_most("change while held", change, 1e-4)
