"""Time: viscosity, inertia and gravity, each compared with its slow, fast and zero limits."""

from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.hard_cases import laws as law
from benchmarks.hard_cases.bodies import MM, PAD, ball, begun, down
from benchmarks.hard_cases.laws import Laws, push
from benchmarks.hard_cases.solver import Case, case
from benchmarks.independent.formulas import layer_sag
from sim.result import Result
from sim.scene import Body, Friction, Gravity, Inertia, Motion, Scene, Viscosity

# Stiffness of the only branch over the equilibrium stiffness, and its relaxation time [s].
RATIO, TIME = 0.5, 0.2
VISCOUS = Viscosity(ratios=(RATIO,), times=(TIME,))
FOUR_BRANCHES = Viscosity((1.0, 0.5, 0.3, 0.2), (1e-3, 0.05, 0.5, 10.0), relaxes="shear")
ELASTIC = ball(down(1), PAD)
# Equal steps down and up [mm].
CYCLE = (0.25, 0.5, 0.75, 1.0, 0.75, 0.5, 0.25, 0.0)
INSIDE = Motion(tip=((0.0, 0.0, -1 * MM),) * 2, time=(0.0, 50 * TIME))
# Pressed within 0.1 s, released within 0.1 ms, and watched for 10 ms.
RELEASED = Motion(
    tip=((0.0, 0.0, 0.0), (0.0, 0.0, -1 * MM), *((0.0, 0.0, 5 * MM),) * 41),
    time=(0.0, 0.1, *(0.1001 + 0.25e-3 * step for step in range(41))),
)
# Its sides are 10 thicknesses away: an effect of 0.2 % on its sag (4 % at 6 thicknesses).
WIDE = Body(size_x=40 * MM, size_y=40 * MM, thickness=2 * MM)
SOFT = replace(PAD, modulus=5e3)
DOWN, UP, SIDEWAYS = (Gravity(a) for a in ((0, 0, -9.81), (0, 0, 9.81), (9.81, 0, 0)))
SHEARED = down(0.8, shear=0.5, steps=3)
OTHERS: dict[str, Any] = {"viscosity": VISCOUS, "inertia": Inertia(), "gravity": DOWN}
FINE: dict[str, Any] = {"spacing": 2 / 3 * MM, "precision": "float64"}


def _with_and_without(motion: Motion, **effects: Any) -> list[Scene]:
    return [ball(motion, PAD, **effects), ball(motion, PAD)]


@case(ball(down(1, hold=10 * TIME, steps=20, speed=0.1), PAD, viscosity=VISCOUS), ELASTIC)
def ramp_and_hold_relaxes(viscous: Result, elastic: Result) -> Laws:
    """After a fast ramp the force decreases ever more slowly to the elastic force, never below."""
    force, rest = push(viscous)[20:], push(elastic)[-1]
    # A fraction of exp(-10) of the branch remains after 10 relaxation times; 1e-4 of the force is
    # the solver's tolerance, 1e-3 of its largest decrease between frames.
    yield law.rises("force decreases while held", -force, -1e-4)
    yield law.rises("ever more slowly", np.diff(force), -5e-3)
    yield law.at_most("end / elastic - 1", abs(force[-1] / rest - 1), 1e-3)
    yield law.dissipates(viscous, 0.01)


@case(ball(down(*CYCLE, speed=1 * MM / TIME), PAD, viscosity=VISCOUS))
def loading_above_unloading(result: Result) -> Laws:
    """At the same depth the force is larger during loading; the closed loop loses work."""
    force = push(result)
    ratio = force[1:4] / np.maximum(force[7:4:-1], 1e-9)
    yield law.at_least("loading / unloading - 1, least", ratio.min() - 1, 0.05)
    yield law.dissipates(result, 0.01)
    yield law.at_least("lost around the loop", result.quality.energy_gap[-1], 0.05)


@case(*(ball(down(1, speed=v), PAD, viscosity=VISCOUS) for v in (1e-4, 3e-3, 1e-2, 1e2)), ELASTIC)
def fast_and_slow_presses(*results: Result) -> Laws:
    """A slow press is elastic, a fast one is elastic times 1 + ratio, others lie between."""
    *moving, elastic = law.ends(results)
    force = [each / elastic for each in moving]
    # 10 s is 50 relaxation times: a ramp lags by 1/50 times ratio. In 10 us, 1/20,000 relaxes; but
    # the contact springs do not stiffen with the material: 2/1000 of the force.
    yield law.rises("force rises with speed", force)
    yield law.at_most("slow / elastic - 1", abs(force[0] - 1), 0.03)
    yield law.at_most("fast / (elastic (1 + ratio)) - 1", abs(force[-1] / (1 + RATIO) - 1), 5e-3)


@case(*_with_and_without(down(*CYCLE), viscosity=Viscosity((0.0,), (TIME,))))
def viscosity_of_no_stiffness(viscous: Result, elastic: Result) -> Laws:
    """A branch without stiffness changes nothing: the elastic force in every frame."""
    yield law.same_force("against no viscosity", elastic, viscous)


@case(ball(down(*CYCLE), PAD, viscosity=FOUR_BRANCHES), det_f=0.3)
def four_branches(result: Result) -> Laws:
    """Four branches from 1 ms to 10 s, in shear only, around a loop: passive in every frame."""
    yield law.dissipates(result, 0.01)


@case(*_with_and_without(down(0.5, 1, speed=1 * MM), inertia=Inertia()))
def slow_press_with_mass(moving: Result, still: Result) -> Laws:
    """Pressed at 1 mm/s, mass is negligible: waves cross the layer 6,000 times per millimetre."""
    yield law.same_force("against quasi-static", still, moving)


@case(*_with_and_without(down(0.25, 0.5, 0.75, 1, speed=2.0), inertia=Inertia()), det_f=0.3)
def fast_press_with_mass(moving: Result, still: Result) -> Laws:
    """Pressed at 2 m/s, a third of the shear wave speed, mass adds to the force."""
    ratio = push(moving)[1] / push(still)[1]
    yield law.at_least("force / quasi-static, at 1/4 mm", ratio, 1.2)


@case(ball(RELEASED, PAD, inertia=Inertia()), det_f=0.3)
def released_body_comes_to_rest(result: Result) -> Laws:
    """Released within 0.1 ms, the skin swings back and comes to rest without gaining energy."""
    size = np.abs(result.surface).reshape(len(RELEASED), -1).max(axis=1)
    # The lowest mode has a period of 2.3 ms. Of its waves, those of a few elements are damped.
    yield law.at_most("largest swing / before", size[2:].max() / size[1], 1.0)
    yield law.at_most("swing after 10 ms / before", size[-4:].max() / size[1], 0.1)
    yield law.at_most("force once released [N]", np.abs(result.force[2:]).max(), 1e-9)


@case(*_with_and_without(down(0.5, 1, speed=10.0), inertia=Inertia(scale=0.0)))
def inertia_of_no_mass(moving: Result, still: Result) -> Laws:
    """Mass scaled by 0 is quasi-static at any speed."""
    yield law.same_force("against no inertia", still, moving)


def _sags(says: str, axis: int, gravity: Gravity) -> Case:
    numbers = (WIDE.thickness, WIDE.density, WIDE.modulus, WIDE.poisson)
    exact = float(layer_sag(0.0, gravity.acceleration, *numbers)[axis])

    @case(ball(begun(5), WIDE, gravity=gravity), says=says, det_f=0.9, **FINE)
    def sagging(result: Result) -> Laws:
        sag = float(result.surface[0, 30, 30, axis])
        yield law.at_most("sag / formula - 1", abs(sag / exact - 1), 0.005)
        yield law.at_most("balance: weight against base", result.quality.balance.max(), 5e-4)

    return sagging


sags_under_gravity = _sags(
    "A wide thin layer sags by density g h^2 / (2 M), and its base carries its weight.", 2, DOWN
)
hangs_sideways = _sags("Gravity along x shears the layer by density g h^2 / (2 G).", 0, SIDEWAYS)


@case(*(ball(down(0.5, 1), SOFT, gravity=gravity) for gravity in (DOWN, None, UP)), det_f=0.4)
def gravity_upside_down(*results: Result) -> Laws:
    """Hanging or standing, a soft gel pressed 1 mm differs by its sag, in opposite directions."""
    force = law.ends(results)
    yield law.rises("a skin that sags outwards is pressed deeper", force)
    mean = (force[0] + force[2]) / 2
    yield law.at_most("mean of both / without - 1", abs(mean / force[1] - 1), 0.01)


@case(*(ball(SHEARED, PAD, friction=Friction(0.5), **each) for each in (OTHERS, {})), det_f=0.3)
def all_effects_at_once(every: Result, rubbed: Result) -> Laws:
    """Friction, viscosity, inertia and gravity together, pressed, sheared and released."""
    yield law.dissipates(every, 0.01)
    yield law.at_least("force with all / with friction", push(every)[3] / push(rubbed)[3], 1.1)


@case(ball(INSIDE, PAD, viscosity=VISCOUS), ELASTIC)
def stays_elastic_when_rested(viscous: Result, elastic: Result) -> Laws:
    """A viscous body pressed for a long time (it starts inside) has the elastic force."""
    yield law.same_end(elastic, viscous, says="after 50 relaxation times")


@case(ball(down(1, *(0.7, 0.4, 0.7, 1) * 3), PAD, viscosity=Viscosity((RATIO,), (0.02,))))
def oscillation_turns_steady(result: Result) -> Laws:
    """Pressed up and down three times, a viscous loop closes from the second round on."""
    _, second, third = push(result)[2:].reshape(3, 4)
    yield law.dissipates(result, 0.01)
    yield law.at_most("third round against second", law.difference(second, third), 1e-3)
