"""The six presses on which solvers are compared."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sim.indenters import flat_punch, rounded_cone, sphere, tube
from sim.scene import Body, Effects, Friction, Scene, Viscosity, press

MM = 1e-3
# Depths of the plain presses [m].
DEPTHS = (0.5 * MM, 1.0 * MM, 1.5 * MM)
# Fineness of a reference's mesh.
FINENESS = 2.0
# Edge radius of shapes that have room for it [m]; sharper edges only need finer elements.
EDGE = 0.5 * MM


@dataclass(frozen=True, slots=True)
class Case:
    """One scene."""

    name: str
    title: str
    scene: Scene
    fineness: float = FINENESS
    """Fineness of the reference's mesh."""


_BODY = Body()
_BALL = sphere(4 * MM)
# Without friction the skin under an edge or a tip slides until it creases, in one of many ways, so
# there is no unique solution to compare with.
_RUB = Effects(friction=Friction(0.5))
# Body: the paper's gel, 20 x 20 x 4 mm, 0.145 MPa, nu 0.45.
CASES: tuple[Case, ...] = (
    Case("sphere", "sphere R 4 mm", Scene(_BALL, press(DEPTHS), body=_BODY)),
    Case(
        "punch",
        "punch R 3, edge 0.5; friction",
        Scene(flat_punch(3 * MM, EDGE), press(DEPTHS), effects=_RUB),
    ),
    Case(
        "cone",
        "cone 45 deg, tip R 0.5; friction",
        Scene(rounded_cone(math.radians(45), EDGE), press(DEPTHS), effects=_RUB),
    ),
    Case(
        "tube",
        "tube 3.5 / 2.5, edge 0.4; friction",
        Scene(tube(3.5 * MM, 2.5 * MM, 0.4 * MM), press(DEPTHS), effects=_RUB),
    ),
    Case(
        "loop",
        "press, shear, return; friction",
        Scene(_BALL, press([1.0 * MM], shear=1.0 * MM, steps=2), effects=_RUB),
    ),
    Case(
        "hold",
        "viscous: ramp and hold",
        Scene(
            _BALL,
            press([1.0 * MM], hold=1.0, steps=4, speed=1.0 * MM / 0.1),
            effects=Effects(viscosity=Viscosity((0.5,), (0.2,))),
        ),
    ),
)

# Smallest of all, for quick runs.
QUICK_CASE = Case("sphere", "sphere R 4 mm", Scene(_BALL, press(DEPTHS[:1]), body=_BODY), 0.8)
