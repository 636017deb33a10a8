"""Precision: units, float32, symmetry, batches and tiers, with the changes that they may cause."""

from dataclasses import replace

import numpy as np

from benchmarks.hard_cases import laws as law
from benchmarks.hard_cases.bodies import MAT, MM, PAD, ball, down
from benchmarks.hard_cases.laws import Laws, push
from benchmarks.hard_cases.solver import Solver, by_hand, case, same_as_alone
from sim.indenters import shapes
from sim.layer import Layer
from sim.result import Result
from sim.scene import Body, Friction, Scene, press
from sim.tiers import simulate

PRESS = down(0.5, 1.0, 1.5)
SHALLOW = ball(down(0.2, 0.3), MAT)
BOTH = ({"precision": "float32"}, {"precision": "float64"})
SURFACE = "surface: |du| / |u|"


@case(ball(PRESS), variants=BOTH)
def float32_against_float64(single: Result, double: Result) -> Laws:
    """Force and skin in float32 agree with those in float64 to within the tolerance."""
    yield law.same_force("force", double, single)
    yield law.at_most(SURFACE, law.difference(double.surface, single.surface), 1e-3)


# At a third of the default tolerance, where energy differences have no digits left in float32.
@case(
    Scene(shapes.flat_punch(3 * MM, 0.3 * MM), down(0.3, 0.6), PAD), variants=BOTH, tolerance=3e-5
)
def float32_reaches_its_tolerance(single: Result, double: Result) -> Laws:
    """Down to its tolerance, float32 converges like float64: rounding stops no Newton step."""
    spent, needed = (result.quality.newton.sum() for result in (single, double))
    yield law.at_most("Newton iterations / those in float64", spent / needed, 1.5)
    cut = single.quality.steps.sum() - double.quality.steps.sum()
    yield law.at_most("steps beyond those in float64", cut, 0)


@case(ball(PRESS), variants=[{"tolerance": t} for t in (1e-4, 1e-7)], precision="float64")
def tighter_tolerance(loose: Result, tight: Result) -> Laws:
    """The tolerance is reliable: at 1e-7 the force changes by less than 1e-4 implies."""
    yield law.same_force("force", tight, loose)
    yield law.at_most("residual", tight.quality.residual.max(), 1e-7)
    # Summed over the nodes.
    yield law.at_most("balance", tight.quality.balance.max(), 1e-6)


@by_hand
def metres_and_millimetres(solver: Solver) -> Laws:
    """A scene a thousand times larger has a million times the force: only ratios matter."""

    def sized(unit: float) -> Result:
        motion, body = press([0.02 * unit, 0.05 * unit]), Body(0.8 * unit, 0.8 * unit, 0.2 * unit)
        return solver.one(Scene(shapes.sphere(0.2 * unit), motion, body), spacing=0.05 * unit)

    little, big = sized(MM), sized(1.0)
    yield from law.validity_laws(little, big, det_f=0.5)
    # The solver works in units of the thickness: only the last digit of float32 differs.
    yield law.at_most("force / 1e6", law.difference(little.force * 1e6, big.force), 1e-5)
    torque = law.difference(little.wrench[:, 3:] * 1e9, big.wrench[:, 3:])
    yield law.at_most("torque / 1e9", torque, 1e-4)
    yield law.at_most("surface / 1e3", law.difference(little.surface * 1e3, big.surface), 1e-5)


@case(ball(PRESS))
def mirror_symmetry(result: Result) -> Laws:
    """A centred press is symmetric under reflection, and under exchange of x and y."""
    yield law.mirrored(result, result, law.LAST_DIGITS)
    yield law.swapped(result, result, law.LAST_DIGITS)


@case(*(Scene(shapes.box(x * MM, y * MM, 0.5 * MM), PRESS) for x, y in ((3, 5), (5, 3))), det_f=0.1)
def swap_symmetry(along_y: Result, along_x: Result) -> Laws:
    """A 3 x 5 mm box along y gives the result of the same box along x, with x and y exchanged."""
    yield law.swapped(along_y, along_x, law.SAME)


@case(*(ball(down(0.5, 1.0, 1.5, at=(x, 0))) for x in (0, 1)))
def shift_by_a_cell(here: Result, there: Result) -> Laws:
    """Pressed one element further, the deformation under the indenter moves by one node."""
    near, far = here.surface[-1, 7:14, 7:14], there.surface[-1, 8:15, 7:14]
    # The sides are 10 and 9 mm away: an effect of exp(-0.78 * 9 / 4), about 0.1 %.
    yield law.at_most("force", abs(push(there)[-1] / push(here)[-1] - 1), 0.005)
    yield law.at_most(SURFACE, law.difference(near, far), 0.01)


@by_hand
def batch_against_alone(solver: Solver) -> Laws:
    """Different presses solved in one batch equal the presses solved alone, bit for bit."""
    punch = Scene(shapes.flat_punch(2 * MM, 0.5 * MM), down(0.3), PAD)
    stiff = ball(down(0.9, at=(1, 0)), replace(PAD, modulus=1e6, poisson=0.3))
    return same_as_alone(solver, [ball(PRESS, PAD), punch, stiff])


@by_hand
def batch_with_friction(solver: Solver) -> Laws:
    """The same with friction, where the memory of contact points must not mix between presses."""
    motion = down(0.6, shear=0.3, steps=2)
    return same_as_alone(solver, [ball(motion, PAD, friction=Friction(mu)) for mu in (0.2, 0.9)])


@case(*[ball(PRESS, PAD)] * 2)
def repeats(first: Result, second: Result) -> Laws:
    """The same scene solved twice gives identical bits."""
    yield law.alike(first, second)


@case(SHALLOW, spacing=0.5 * MM)
def layer_against_fem(fem: Result) -> Laws:
    """At 0.2 and 0.3 mm the linear layer and the finite elements agree within 2 %."""
    # Large strain adds 0.7 % at 0.3 mm, elements of 0.5 mm on a contact of 1 mm radius 1 %.
    yield law.at_most("force", law.difference(fem.force, simulate(SHALLOW, Layer()).force), 0.02)


@case(ball(down(0.75, 1.5), MAT), variants=({"spacing": 1 * MM}, {"spacing": 0.5 * MM}))
def finer_mesh(coarse: Result, fine: Result) -> Laws:
    """Halving the elements from 1 to 0.5 mm changes the force by no more than 2 %."""
    # Linear elements: the error decreases with the square of the spacing; it is 0.4 % at 1 mm and
    # 1.5 mm deep, more where the contact spans only two elements.
    yield law.at_most("force at 1.5 mm", abs(push(fine)[-1] / push(coarse)[-1] - 1), 0.02)
    yield law.at_least("layers of the fine mesh", fine.record["mesh"]["cells"][2], 8)


@case(ball(PRESS))
def torque_of_a_centred_press(result: Result) -> Laws:
    """A centred press has no torque about its tip."""
    # A lever of a thousandth of the contact radius (3 mm).
    lever = np.abs(result.wrench[:, 3:]).max() / push(result).max()
    yield law.at_most("torque / force [m]", lever, 3e-6)
