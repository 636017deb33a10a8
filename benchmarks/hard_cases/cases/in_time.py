"""Time: viscosity, inertia and gravity, each compared with its slow, fast and zero limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.hard_cases.cases.bodies import MM, PAD, SPHERE
from benchmarks.hard_cases.laws import (
    BALANCE,
    SAME,
    Law,
    at_least,
    at_most,
    difference,
    dissipates,
    lets_go,
    push,
    rises,
    same_end,
    same_force,
    slides,
    validity_laws,
)
from benchmarks.hard_cases.solver import Solver
from benchmarks.independent.formulas import layer_sag
from sim.scene import Body, Effects, Friction, Gravity, Inertia, Motion, Scene, Viscosity, press

# Stiffness of the only branch over the equilibrium stiffness, and its relaxation time [s].
RATIO, TIME = 0.5, 0.2
VISCOUS = Effects(viscosity=Viscosity(ratios=(RATIO,), times=(TIME,)))
DEPTH = 1 * MM
# Depths over the largest, with equal steps down and up.
THERE_AND_BACK = (0.25, 0.5, 0.75, 1.0, 0.75, 0.5, 0.25, 0.0)


def _cycle(speed: float) -> Motion:
    return press([DEPTH * fraction for fraction in THERE_AND_BACK], speed=speed)


def ramp_and_hold_relaxes(solver: Solver) -> list[Law]:
    """After a fast ramp the force decreases ever more slowly to the elastic force, never below."""
    hold = press([DEPTH], hold=10 * TIME, steps=20, speed=DEPTH / 0.01)
    viscous = solver.one(Scene(SPHERE, hold, PAD, VISCOUS))
    elastic = solver.one(Scene(SPHERE, press([DEPTH]), PAD))
    force, rest = push(viscous)[20:], push(elastic)[-1]
    # A fraction of exp(-10) of the branch remains after 10 relaxation times; 1e-4 of the force is
    # the solver's tolerance, 1e-3 of its largest decrease between frames.
    return [
        *validity_laws(viscous, det_f=0.5),
        rises("force decreases while held", -force, -1e-4),
        rises("ever more slowly", np.diff(force), -5e-3),
        at_most("end / elastic - 1", abs(force[-1] / rest - 1), 1e-3),
        dissipates(viscous, 0.01),
    ]


def loading_above_unloading(solver: Solver) -> list[Law]:
    """At the same depth the force is larger during loading; the closed loop loses work."""
    result = solver.one(Scene(SPHERE, _cycle(DEPTH / TIME), PAD, VISCOUS))
    force = push(result)
    down, up = force[1:4], force[7:4:-1]
    return [
        *validity_laws(result, det_f=0.5),
        at_least(
            "loading / unloading - 1, least", float((down / np.maximum(up, 1e-9)).min() - 1), 0.05
        ),
        dissipates(result, 0.01),
        at_least("lost around the loop", result.quality.energy_gap[-1], 0.05),
        lets_go(result),
    ]


def fast_and_slow_presses(solver: Solver) -> list[Law]:
    """A slow press is elastic, a fast one is elastic times 1 + ratio, others lie between."""
    speeds = (1e-4, 3e-3, 1e-2, 1e2)
    results = [
        solver.one(Scene(SPHERE, press([DEPTH], speed=speed), PAD, VISCOUS)) for speed in speeds
    ]
    elastic = push(solver.one(Scene(SPHERE, press([DEPTH]), PAD)))[-1]
    force = [push(result)[-1] / elastic for result in results]
    # 10 s is 50 relaxation times: a ramp lags by 1/50 times ratio. In 10 us, 1/20,000 relaxes; but
    # the contact springs do not stiffen with the material: 2/1000 of the force.
    return [
        *validity_laws(*results, det_f=0.5),
        rises("force rises with speed", force),
        at_most("slow / elastic - 1", abs(force[0] - 1), 0.03),
        at_most("fast / (elastic (1 + ratio)) - 1", abs(force[-1] / (1 + RATIO) - 1), 5e-3),
    ]


def viscosity_of_no_stiffness(solver: Solver) -> list[Law]:
    """A branch without stiffness changes nothing: the elastic force in every frame."""
    effects = Effects(viscosity=Viscosity(ratios=(0.0,), times=(TIME,)))
    motion = _cycle(10 * MM)
    viscous = solver.one(Scene(SPHERE, motion, PAD, effects))
    elastic = solver.one(Scene(SPHERE, motion, PAD))
    return [same_force("against no viscosity", elastic, viscous, SAME)]


def four_branches(solver: Solver) -> list[Law]:
    """Four branches from 1 ms to 10 s, in shear only, around a loop: passive in every frame."""
    viscosity = Viscosity(
        ratios=(1.0, 0.5, 0.3, 0.2), times=(1e-3, 0.05, 0.5, 10.0), relaxes="shear"
    )
    result = solver.one(Scene(SPHERE, _cycle(10 * MM), PAD, Effects(viscosity=viscosity)))
    return [*validity_laws(result, det_f=0.3), dissipates(result, 0.01), lets_go(result)]


def slow_press_with_mass(solver: Solver) -> list[Law]:
    """Pressed at 1 mm/s, mass is negligible: waves cross the layer 6,000 times per millimetre."""
    motion = press([0.5 * MM, 1 * MM], speed=1 * MM)
    moving = solver.one(Scene(SPHERE, motion, PAD, Effects(inertia=Inertia())))
    still = solver.one(Scene(SPHERE, motion, PAD))
    return [
        *validity_laws(moving, det_f=0.5),
        same_force("against quasi-static", still, moving, SAME),
    ]


def fast_press_with_mass(solver: Solver) -> list[Law]:
    """Pressed at 2 m/s, a third of the shear wave speed, mass adds to the force."""
    motion = press([0.25 * MM, 0.5 * MM, 0.75 * MM, 1 * MM], speed=2.0)
    moving = solver.one(Scene(SPHERE, motion, PAD, Effects(inertia=Inertia())))
    still = solver.one(Scene(SPHERE, motion, PAD))
    return [
        *validity_laws(moving, det_f=0.3),
        at_least("force / quasi-static, at 1/4 mm", push(moving)[1] / push(still)[1], 1.2),
    ]


def released_body_comes_to_rest(solver: Solver) -> list[Law]:
    """Released within 0.1 ms, the skin swings back and comes to rest without gaining energy."""
    tip = [(0.0, 0.0, 0.0), (0.0, 0.0, -DEPTH), (0.0, 0.0, 5 * MM)]
    time = [0.0, 0.1, 0.1001]
    for step in range(1, 41):
        tip.append((0.0, 0.0, 5 * MM))
        time.append(0.1001 + 0.25e-3 * step)
    scene = Scene(SPHERE, Motion(tip=tuple(tip), time=tuple(time)), PAD, Effects(inertia=Inertia()))
    result = solver.one(scene)
    size = np.abs(result.surface).reshape(len(tip), -1).max(axis=1)
    # The lowest mode has a period of 2.3 ms; backward Euler with 0.25 ms removes a third of its
    # amplitude per period: after 4 periods a hundredth to a tenth of it remains.
    return [
        at_least("smallest det F", result.quality.det_f_min.min(), 0.3),
        at_most("balance while pressed", result.quality.balance[1], BALANCE),
        at_most("largest swing / before", size[2:].max() / size[1], 1.0),
        at_most("swing after 10 ms / before", size[-4:].max() / size[1], 0.1),
        at_most("force once released [N]", float(np.abs(result.force[2:]).max()), 1e-9),
    ]


def inertia_of_no_mass(solver: Solver) -> list[Law]:
    """Mass scaled by 0 is quasi-static at any speed."""
    motion = press([0.5 * MM, 1 * MM], speed=10.0)
    light = solver.one(Scene(SPHERE, motion, PAD, Effects(inertia=Inertia(scale=0.0))))
    still = solver.one(Scene(SPHERE, motion, PAD))
    return [same_force("against no inertia", still, light, SAME)]


WIDE = Body(size_x=40 * MM, size_y=40 * MM, thickness=2 * MM)
ABOVE = Motion(tip=((0.0, 0.0, 5 * MM),), time=(0.0,))


def _sag(solver: Solver, pull: tuple[float, float, float], axis: int) -> list[Law]:
    scene = Scene(SPHERE, ABOVE, WIDE, Effects(gravity=Gravity(pull)))
    result = solver.one(scene, spacing=2 / 3 * MM, precision="float64")
    middle = result.surface[0, 30, 30]
    exact = layer_sag(0.0, pull, WIDE.thickness, WIDE.density, WIDE.modulus, WIDE.poisson)
    # The sides are 10 thicknesses away: an effect of 0.2 % (4 % at 6 thicknesses).
    return [
        at_most("sag / formula - 1", abs(float(middle[axis]) / float(exact[axis]) - 1), 0.005),
        at_most("balance: weight against base", result.quality.balance.max(), 5e-4),
        at_least("smallest det F", result.quality.det_f_min.min(), 0.9),
    ]


def sags_under_gravity(solver: Solver) -> list[Law]:
    """A wide thin layer sags by density g h^2 / (2 M), and its base carries its weight."""
    return _sag(solver, (0.0, 0.0, -9.81), 2)


def hangs_sideways(solver: Solver) -> list[Law]:
    """Gravity along x shears the layer by density g h^2 / (2 G)."""
    return _sag(solver, (9.81, 0.0, 0.0), 0)


def gravity_upside_down(solver: Solver) -> list[Law]:
    """Hanging or standing, a soft gel pressed 1 mm differs by its sag, in opposite directions."""
    soft = replace(PAD, modulus=5e3)
    up, none, down = (
        solver.one(Scene(SPHERE, press([0.5 * MM, 1 * MM]), soft, effects))
        for effects in (
            Effects(gravity=Gravity((0.0, 0.0, 9.81))),
            Effects(),
            Effects(gravity=Gravity((0.0, 0.0, -9.81))),
        )
    )
    force = [push(result)[-1] for result in (down, none, up)]
    middle = (force[0] + force[2]) / 2
    return [
        *validity_laws(up, none, down, det_f=0.4),
        rises("a skin that sags outwards is pressed deeper", force),
        at_most("mean of both / without - 1", abs(middle / force[1] - 1), 0.01),
    ]


def all_effects_at_once(solver: Solver) -> list[Law]:
    """Friction, viscosity, inertia and gravity together, pressed, sheared and released."""
    effects = Effects(
        friction=Friction(0.5), viscosity=VISCOUS.viscosity, inertia=Inertia(), gravity=Gravity()
    )
    motion = press([0.8 * MM], shear=0.5 * MM, steps=3)
    batched = solver.one(Scene(SPHERE, motion, PAD, effects))
    rubbed = solver.one(Scene(SPHERE, motion, PAD, Effects(friction=Friction(0.5))))
    return [
        *validity_laws(batched, det_f=0.3),
        slides(batched),
        dissipates(batched, 0.01),
        at_least("force with all / with friction", push(batched)[3] / push(rubbed)[3], 1.1),
        lets_go(batched),
    ]


def stays_elastic_when_rested(solver: Solver) -> list[Law]:
    """A viscous body pressed for a long time (it starts inside) has the elastic force."""
    inside = Motion(tip=((0.0, 0.0, -DEPTH), (0.0, 0.0, -DEPTH)), time=(0.0, 50 * TIME))
    viscous = solver.one(Scene(SPHERE, inside, PAD, VISCOUS))
    elastic = solver.one(Scene(SPHERE, press([DEPTH]), PAD))
    return [
        *validity_laws(viscous, det_f=0.5),
        same_end("after 50 relaxation times", elastic, viscous, SAME),
    ]


def oscillation_turns_steady(solver: Solver) -> list[Law]:
    """Pressed up and down three times, a viscous loop closes from the second round on."""
    round_ = [0.7 * MM, 0.4 * MM, 0.7 * MM, 1 * MM]
    motion = press([1 * MM, *round_ * 3], speed=10 * MM)
    viscosity = Viscosity(ratios=(RATIO,), times=(0.02,))
    result = solver.one(Scene(SPHERE, motion, PAD, Effects(viscosity=viscosity)))
    rounds = push(result)[2:].reshape(3, 4)
    return [
        *validity_laws(result, det_f=0.5),
        dissipates(result, 0.01),
        at_most("third round against second", difference(rounds[1], rounds[2]), 1e-3),
    ]
