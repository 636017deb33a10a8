"""Precision: units, float32, symmetry, batches and tiers, with the changes that they may cause."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.hard_cases import laws as law
from benchmarks.hard_cases.cases.bodies import MAT, MM, PAD, ball
from benchmarks.hard_cases.laws import Law, push
from benchmarks.hard_cases.solver import Case, Solver, case
from sim.indenters import shapes
from sim.layer import Layer
from sim.result import Result
from sim.scene import Body, Friction, Scene, press
from sim.tiers import simulate

PRESS = press([0.5 * MM, 1.0 * MM, 1.5 * MM])
PUNCH = shapes.flat_punch(3 * MM, 0.3 * MM)
SHALLOW = ball(press([0.2 * MM, 0.3 * MM]), MAT)
BOTH = ({"precision": "float32"}, {"precision": "float64"})
SURFACE = "surface: |du| / |u|"


def _sized(factor: float) -> Scene:
    """Return a press into a gel of 0.8 mm times the factor."""
    width, thickness = 0.8 * MM * factor, 0.2 * MM * factor
    motion = press([0.02 * MM * factor, 0.05 * MM * factor])
    return Scene(shapes.sphere(0.2 * MM * factor), motion, Body(width, width, thickness))


def _converges_alike(single: Result, double: Result) -> list[Law]:
    spent, needed = (int(result.quality.newton.sum()) for result in (single, double))
    cut = int(single.quality.steps.sum() - double.quality.steps.sum())
    return [
        law.at_most("Newton iterations / those in float64", spent / needed, 1.5),
        law.at_most("steps beyond those in float64", cut, 0),
    ]


def _metres_and_millimetres(solver: Solver) -> list[Law]:
    """A scene a thousand times larger has a million times the force: only ratios matter."""
    little = solver.one(_sized(1.0), spacing=0.05 * MM)
    big = solver.one(_sized(1e3), spacing=0.05)
    torque = law.difference(little.wrench[:, 3:] * 1e9, big.wrench[:, 3:])
    # The solver works in units of the thickness: only the last digit of float32 differs.
    return [
        *law.validity_laws(little, big, det_f=0.5),
        law.at_most("force / 1e6", law.difference(little.force * 1e6, big.force), 1e-5),
        law.at_most("torque / 1e9", torque, 1e-4),
        law.at_most("surface / 1e3", law.difference(little.surface * 1e3, big.surface), 1e-5),
    ]


def _shifted(here: Result, there: Result) -> list[Law]:
    near, far = here.surface[-1, 7:14, 7:14], there.surface[-1, 8:15, 7:14]
    # The sides are 10 and 9 mm away: an effect of exp(-0.78 * 9 / 4), about 0.1 %.
    return [
        law.at_most("force", abs(push(there)[-1] / push(here)[-1] - 1), 0.005),
        law.at_most(SURFACE, law.difference(near, far), 0.01),
    ]


def _alone(says: str, scenes: list[Scene]) -> Case:
    """Return the case that scenes of one batch equal those solved alone, bit for bit."""

    def laws(solver: Solver) -> list[Law]:
        batched = zip(scenes, solver.many(scenes), strict=True)
        return [each for scene, result in batched for each in law.alike(solver.one(scene), result)]

    laws.__doc__ = says
    return laws


def _no_torque(result: Result) -> list[Law]:
    lever = np.abs(result.wrench[:, 3:]).max() / push(result).max()
    # A lever of a thousandth of the contact radius (3 mm).
    return [law.at_most("torque / force [m]", float(lever), 3e-6)]


CASES: dict[str, Case] = {
    "float32-against-float64": case(
        "Force and skin in float32 agree with those in float64 to within the tolerance.",
        [ball(PRESS)],
        lambda single, double: [
            law.same_force("force", double, single, law.SAME),
            law.at_most(SURFACE, law.difference(double.surface, single.surface), 1e-3),
        ],
        variants=BOTH,
    ),
    "float32-reaches-its-tolerance": case(
        "Down to its tolerance, float32 converges like float64: rounding stops no Newton step.",
        [Scene(PUNCH, press([0.3 * MM, 0.6 * MM]), PAD)],
        _converges_alike,
        variants=BOTH,
        # A third of the default, where energy differences have no digits left in float32.
        tolerance=3e-5,
    ),
    "tighter-tolerance": case(
        "The tolerance is reliable: at 1e-7 the force changes by less than 1e-4 implies.",
        [ball(PRESS)],
        lambda loose, tight: [
            law.same_force("force", tight, loose, law.SAME),
            law.at_most("residual", tight.quality.residual.max(), 1e-7),
            # Summed over the nodes.
            law.at_most("balance", tight.quality.balance.max(), 1e-6),
        ],
        det_f=None,
        variants=({"tolerance": 1e-4}, {"tolerance": 1e-7}),
        precision="float64",
    ),
    "metres-and-millimetres": _metres_and_millimetres,
    "mirror-symmetry": case(
        "A centred press is symmetric under reflection, and under exchange of x and y.",
        [ball(PRESS)],
        lambda result: [
            law.mirrored(result, result, law.LAST_DIGITS),
            law.swapped(result, result, law.LAST_DIGITS),
        ],
    ),
    "swap-symmetry": case(
        "A 3 x 5 mm box along y gives the result of the same box along x, with x and y exchanged.",
        [
            Scene(shapes.box(width, length, 0.5 * MM), PRESS)
            for width, length in ((3 * MM, 5 * MM), (5 * MM, 3 * MM))
        ],
        lambda along_y, along_x: [law.swapped(along_y, along_x, law.SAME)],
        det_f=0.1,
    ),
    "shift-by-a-cell": case(
        "Pressed one element further, the deformation under the indenter moves by one node.",
        [ball(press([0.5 * MM, 1.0 * MM, 1.5 * MM], at=(x, 0.0))) for x in (0.0, MM)],
        _shifted,
    ),
    "batch-against-alone": _alone(
        "Different presses solved in one batch equal the presses solved alone, bit for bit.",
        [
            ball(PRESS, PAD),
            Scene(shapes.flat_punch(2 * MM, 0.5 * MM), press([0.3 * MM]), PAD),
            ball(press([0.9 * MM], at=(MM, 0.0)), replace(PAD, modulus=1e6, poisson=0.3)),
        ],
    ),
    "batch-with-friction": _alone(
        "The same with friction, where the memory of contact points must not mix between presses.",
        [
            ball(press([0.6 * MM], shear=0.3 * MM, steps=2), PAD, friction=Friction(coefficient))
            for coefficient in (0.2, 0.9)
        ],
    ),
    "repeats": case(
        "The same scene solved twice gives identical bits.",
        [ball(PRESS, PAD)] * 2,
        law.alike,
        det_f=None,
    ),
    "layer-against-fem": case(
        "At 0.2 and 0.3 mm the linear layer and the finite elements agree within 2 %.",
        [SHALLOW],
        # Large strain adds 0.7 % at 0.3 mm, elements of 0.5 mm on a contact of 1 mm radius 1 %.
        lambda fem: [
            law.at_most("force", law.difference(fem.force, simulate(SHALLOW, Layer()).force), 0.02)
        ],
        spacing=0.5 * MM,
    ),
    "finer-mesh": case(
        "Halving the elements from 1 to 0.5 mm changes the force by no more than 2 %.",
        [ball(press([0.75 * MM, 1.5 * MM]), MAT)],
        # Linear elements: the error decreases with the square of the spacing; it is 0.4 % at 1 mm
        # and 1.5 mm deep, more where the contact spans only two elements.
        lambda coarse, fine: [
            law.at_most("force at 1.5 mm", abs(push(fine)[-1] / push(coarse)[-1] - 1), 0.02),
            law.at_least("layers of the fine mesh", fine.record["mesh"]["cells"][2], 8),
        ],
        variants=({"spacing": 1 * MM}, {"spacing": 0.5 * MM}),
    ),
    "torque-of-a-centred-press": case(
        "A centred press has no torque about its tip.", [ball(PRESS)], _no_torque
    ),
}
