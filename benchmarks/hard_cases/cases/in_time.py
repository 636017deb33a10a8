"""Time: viscosity, inertia and gravity, each compared with its slow, fast and zero limits."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.hard_cases import laws as law
from benchmarks.hard_cases.cases.bodies import MM, PAD, ball
from benchmarks.hard_cases.laws import Law, push
from benchmarks.hard_cases.solver import Case, case
from benchmarks.independent.formulas import layer_sag
from sim.result import Result
from sim.scene import Body, Friction, Gravity, Inertia, Motion, Viscosity, press

# Stiffness of the only branch over the equilibrium stiffness, and its relaxation time [s].
RATIO, TIME = 0.5, 0.2
VISCOUS = Viscosity(ratios=(RATIO,), times=(TIME,))
FOUR_BRANCHES = Viscosity((1.0, 0.5, 0.3, 0.2), (1e-3, 0.05, 0.5, 10.0), relaxes="shear")
DEPTH = 1 * MM
ALL_AT_ONCE = press([0.8 * MM], shear=0.5 * MM, steps=3)
# Presses of a sphere that is above and of one that is inside.
ABOVE = Motion(tip=((0.0, 0.0, 5 * MM),), time=(0.0,))
INSIDE = Motion(tip=((0.0, 0.0, -DEPTH), (0.0, 0.0, -DEPTH)), time=(0.0, 50 * TIME))
# Pressed within 0.1 s, released within 0.1 ms, and watched for 10 ms.
RELEASED = Motion(
    tip=((0.0, 0.0, 0.0), (0.0, 0.0, -DEPTH), *((0.0, 0.0, 5 * MM),) * 41),
    time=(0.0, 0.1, *(0.1001 + 0.25e-3 * step for step in range(41))),
)
WIDE = Body(size_x=40 * MM, size_y=40 * MM, thickness=2 * MM)


def _cycle(speed: float) -> Motion:
    """Return equal steps down and up."""
    depths = (0.25, 0.5, 0.75, 1.0, 0.75, 0.5, 0.25, 0.0)
    return press([DEPTH * fraction for fraction in depths], speed=speed)


def _same(
    says: str, against: str, motion: Motion, det_f: float | None = None, **effect: Any
) -> Case:
    """Return the case that an effect changes no force."""
    return case(
        says,
        [ball(motion, PAD, **effect), ball(motion, PAD)],
        lambda with_it, without: [law.same_force(against, without, with_it, law.SAME)],
        det_f=det_f,
    )


def _relaxes(viscous: Result, elastic: Result) -> list[Law]:
    force, rest = push(viscous)[20:], push(elastic)[-1]
    # A fraction of exp(-10) of the branch remains after 10 relaxation times; 1e-4 of the force is
    # the solver's tolerance, 1e-3 of its largest decrease between frames.
    return [
        law.rises("force decreases while held", -force, -1e-4),
        law.rises("ever more slowly", np.diff(force), -5e-3),
        law.at_most("end / elastic - 1", abs(force[-1] / rest - 1), 1e-3),
        law.dissipates(viscous, 0.01),
    ]


def _loses(result: Result) -> list[Law]:
    force = push(result)
    ratio = force[1:4] / np.maximum(force[7:4:-1], 1e-9)
    return [
        law.at_least("loading / unloading - 1, least", float(ratio.min() - 1), 0.05),
        law.dissipates(result, 0.01),
        law.at_least("lost around the loop", result.quality.energy_gap[-1], 0.05),
        law.lets_go(result),
    ]


def _between_limits(*results: Result) -> list[Law]:
    *moving, elastic = (push(result)[-1] for result in results)
    force = [each / elastic for each in moving]
    # 10 s is 50 relaxation times: a ramp lags by 1/50 times ratio. In 10 us, 1/20,000 relaxes; but
    # the contact springs do not stiffen with the material: 2/1000 of the force.
    return [
        law.rises("force rises with speed", force),
        law.at_most("slow / elastic - 1", abs(force[0] - 1), 0.03),
        law.at_most("fast / (elastic (1 + ratio)) - 1", abs(force[-1] / (1 + RATIO) - 1), 5e-3),
    ]


def _comes_to_rest(result: Result) -> list[Law]:
    size = np.abs(result.surface).reshape(len(RELEASED), -1).max(axis=1)
    # The lowest mode has a period of 2.3 ms; backward Euler with 0.25 ms removes a third of its
    # amplitude per period: after 4 periods a hundredth to a tenth of it remains.
    return [
        law.at_least("smallest det F", result.quality.det_f_min.min(), 0.3),
        law.at_most("balance while pressed", result.quality.balance[1], law.BALANCE),
        law.at_most("largest swing / before", size[2:].max() / size[1], 1.0),
        law.at_most("swing after 10 ms / before", size[-4:].max() / size[1], 0.1),
        law.at_most("force once released [N]", float(np.abs(result.force[2:]).max()), 1e-9),
    ]


def _sag(says: str, pull: tuple[float, float, float], axis: int) -> Case:
    exact = layer_sag(0.0, pull, WIDE.thickness, WIDE.density, WIDE.modulus, WIDE.poisson)[axis]
    return case(
        says,
        [ball(ABOVE, WIDE, gravity=Gravity(pull))],
        # The sides are 10 thicknesses away: an effect of 0.2 % (4 % at 6 thicknesses).
        lambda result: [
            law.at_most(
                "sag / formula - 1",
                abs(float(result.surface[0, 30, 30, axis]) / float(exact) - 1),
                0.005,
            ),
            law.at_most("balance: weight against base", result.quality.balance.max(), 5e-4),
            law.at_least("smallest det F", result.quality.det_f_min.min(), 0.9),
        ],
        det_f=None,
        spacing=2 / 3 * MM,
        precision="float64",
    )


def _opposite(*results: Result) -> list[Law]:
    force = [push(result)[-1] for result in results]
    middle = (force[0] + force[2]) / 2
    return [
        law.rises("a skin that sags outwards is pressed deeper", force),
        law.at_most("mean of both / without - 1", abs(middle / force[1] - 1), 0.01),
    ]


def _turns_steady(result: Result) -> list[Law]:
    rounds = push(result)[2:].reshape(3, 4)
    return [
        law.dissipates(result, 0.01),
        law.at_most("third round against second", law.difference(rounds[1], rounds[2]), 1e-3),
    ]


CASES: dict[str, Case] = {
    "ramp-and-hold-relaxes": case(
        "After a fast ramp the force decreases ever more slowly to the elastic force, never below.",
        [
            ball(
                press([DEPTH], hold=10 * TIME, steps=20, speed=DEPTH / 0.01), PAD, viscosity=VISCOUS
            ),
            ball(press([DEPTH]), PAD),
        ],
        _relaxes,
    ),
    "loading-above-unloading": case(
        "At the same depth the force is larger during loading; the closed loop loses work.",
        [ball(_cycle(DEPTH / TIME), PAD, viscosity=VISCOUS)],
        _loses,
    ),
    "fast-and-slow-presses": case(
        "A slow press is elastic, a fast one is elastic times 1 + ratio, others lie between.",
        [
            *(
                ball(press([DEPTH], speed=speed), PAD, viscosity=VISCOUS)
                for speed in (1e-4, 3e-3, 1e-2, 1e2)
            ),
            ball(press([DEPTH]), PAD),
        ],
        _between_limits,
    ),
    "viscosity-of-no-stiffness": _same(
        "A branch without stiffness changes nothing: the elastic force in every frame.",
        "against no viscosity",
        _cycle(10 * MM),
        viscosity=Viscosity(ratios=(0.0,), times=(TIME,)),
    ),
    "four-branches": case(
        "Four branches from 1 ms to 10 s, in shear only, around a loop: passive in every frame.",
        [ball(_cycle(10 * MM), PAD, viscosity=FOUR_BRANCHES)],
        lambda result: [law.dissipates(result, 0.01), law.lets_go(result)],
        det_f=0.3,
    ),
    "slow-press-with-mass": _same(
        "Pressed at 1 mm/s, mass is negligible: waves cross the layer 6,000 times per millimetre.",
        "against quasi-static",
        press([0.5 * MM, 1 * MM], speed=1 * MM),
        det_f=0.5,
        inertia=Inertia(),
    ),
    "fast-press-with-mass": case(
        "Pressed at 2 m/s, a third of the shear wave speed, mass adds to the force.",
        [
            ball(press([0.25 * MM, 0.5 * MM, 0.75 * MM, 1 * MM], speed=2.0), PAD, inertia=inertia)
            for inertia in (Inertia(), None)
        ],
        lambda moving, still: [
            law.at_least("force / quasi-static, at 1/4 mm", push(moving)[1] / push(still)[1], 1.2)
        ],
        det_f=0.3,
    ),
    "released-body-comes-to-rest": case(
        "Released within 0.1 ms, the skin swings back and comes to rest without gaining energy.",
        [ball(RELEASED, PAD, inertia=Inertia())],
        _comes_to_rest,
        det_f=None,
    ),
    "inertia-of-no-mass": _same(
        "Mass scaled by 0 is quasi-static at any speed.",
        "against no inertia",
        press([0.5 * MM, 1 * MM], speed=10.0),
        inertia=Inertia(scale=0.0),
    ),
    "sags-under-gravity": _sag(
        "A wide thin layer sags by density g h^2 / (2 M), and its base carries its weight.",
        (0.0, 0.0, -9.81),
        2,
    ),
    "hangs-sideways": _sag(
        "Gravity along x shears the layer by density g h^2 / (2 G).", (9.81, 0.0, 0.0), 0
    ),
    "gravity-upside-down": case(
        "Hanging or standing, a soft gel pressed 1 mm differs by its sag, in opposite directions.",
        [
            ball(press([0.5 * MM, 1 * MM]), replace(PAD, modulus=5e3), gravity=gravity)
            for gravity in (Gravity((0.0, 0.0, -9.81)), None, Gravity((0.0, 0.0, 9.81)))
        ],
        _opposite,
        det_f=0.4,
    ),
    "all-effects-at-once": case(
        "Friction, viscosity, inertia and gravity together, pressed, sheared and released.",
        [
            ball(ALL_AT_ONCE, PAD, friction=Friction(0.5), **others)
            for others in ({"viscosity": VISCOUS, "inertia": Inertia(), "gravity": Gravity()}, {})
        ],
        lambda every, rubbed: [
            law.slides(every),
            law.dissipates(every, 0.01),
            law.at_least("force with all / with friction", push(every)[3] / push(rubbed)[3], 1.1),
            law.lets_go(every),
        ],
        det_f=0.3,
    ),
    "stays-elastic-when-rested": case(
        "A viscous body pressed for a long time (it starts inside) has the elastic force.",
        [ball(INSIDE, PAD, viscosity=VISCOUS), ball(press([DEPTH]), PAD)],
        lambda viscous, elastic: [
            law.same_end("after 50 relaxation times", elastic, viscous, law.SAME)
        ],
    ),
    "oscillation-turns-steady": case(
        "Pressed up and down three times, a viscous loop closes from the second round on.",
        [
            ball(
                press([1 * MM, *[0.7 * MM, 0.4 * MM, 0.7 * MM, 1 * MM] * 3], speed=10 * MM),
                PAD,
                viscosity=Viscosity(ratios=(RATIO,), times=(0.02,)),
            )
        ],
        _turns_steady,
    ),
}
