"""Precision: units, float32, symmetry, batches and tiers, with the changes that they may cause."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.hard_cases.cases.bodies import GEL, MAT, MM, PAD, SPHERE
from benchmarks.hard_cases.laws import (
    LAST_DIGITS,
    SAME,
    Law,
    alike,
    at_least,
    at_most,
    difference,
    mirrored,
    push,
    same_force,
    swapped,
    validity_laws,
)
from benchmarks.hard_cases.solver import Solver
from sim.indenters import Indenter, shapes
from sim.layer import Layer
from sim.scene import Body, Effects, Friction, Scene, press
from sim.tiers import simulate

# Tolerance of 1e-7, summed over the nodes.
BALANCE_TIGHT = 1e-6
PRESS = press([0.5 * MM, 1.0 * MM, 1.5 * MM])


def float32_against_float64(solver: Solver) -> list[Law]:
    """Force and skin in float32 agree with those in float64 to within the tolerance."""
    single, double = (
        solver.one(Scene(SPHERE, PRESS), precision=precision)
        for precision in ("float32", "float64")
    )
    return [
        *validity_laws(single, double, det_f=0.5),
        same_force("force", double, single, SAME),
        at_most("surface: |du| / |u|", difference(double.surface, single.surface), 1e-3),
    ]


def float32_reaches_its_tolerance(solver: Solver) -> list[Law]:
    """Down to its tolerance, float32 converges like float64: rounding stops no Newton step."""
    punch = shapes.flat_punch(3 * MM, 0.3 * MM)
    # A third of the default tolerance, where energy differences have no digits left in float32.
    single, double = (
        solver.one(
            Scene(punch, press([0.3 * MM, 0.6 * MM]), PAD), precision=precision, tolerance=3e-5
        )
        for precision in ("float32", "float64")
    )
    spent, needed = (int(result.quality.newton.sum()) for result in (single, double))
    cut = int(single.quality.steps.sum() - double.quality.steps.sum())
    return [
        *validity_laws(single, double, det_f=0.5),
        at_most("Newton iterations / those in float64", spent / needed, 1.5),
        at_most("steps beyond those in float64", cut, 0),
    ]


def tighter_tolerance(solver: Solver) -> list[Law]:
    """The tolerance is reliable: at 1e-7 the force changes by less than 1e-4 implies."""
    loose, tight = (
        solver.one(Scene(SPHERE, PRESS), precision="float64", tolerance=tolerance)
        for tolerance in (1e-4, 1e-7)
    )
    return [
        same_force("force", tight, loose, SAME),
        at_most("residual", tight.quality.residual.max(), 1e-7),
        at_most("balance", tight.quality.balance.max(), BALANCE_TIGHT),
    ]


def metres_and_millimetres(solver: Solver) -> list[Law]:
    """A scene a thousand times larger has a million times the force: only ratios matter."""
    small = Body(size_x=0.8 * MM, size_y=0.8 * MM, thickness=0.2 * MM)
    large = Body(size_x=0.8, size_y=0.8, thickness=0.2)
    depths = [0.02 * MM, 0.05 * MM]
    little = solver.one(Scene(shapes.sphere(0.2 * MM), press(depths), small), spacing=0.05 * MM)
    big = solver.one(
        Scene(shapes.sphere(0.2), press([1e3 * depth for depth in depths]), large), spacing=0.05
    )
    # The solver works in units of the thickness: only the last digit of float32 differs.
    return [
        *validity_laws(little, big, det_f=0.5),
        at_most("force / 1e6", difference(little.force * 1e6, big.force), 1e-5),
        at_most("torque / 1e9", difference(little.wrench[:, 3:] * 1e9, big.wrench[:, 3:]), 1e-4),
        at_most("surface / 1e3", difference(little.surface * 1e3, big.surface), 1e-5),
    ]


def mirror_symmetry(solver: Solver) -> list[Law]:
    """A centred press is symmetric under reflection, and under exchange of x and y."""
    centred = solver.one(Scene(SPHERE, PRESS))
    return [
        *validity_laws(centred, det_f=0.5),
        mirrored(centred, centred, LAST_DIGITS),
        swapped(centred, centred, LAST_DIGITS),
    ]


def swap_symmetry(solver: Solver) -> list[Law]:
    """A 3 x 5 mm box along y gives the result of the same box along x, with x and y exchanged."""
    along_y, along_x = (
        solver.one(Scene(indenter, PRESS))
        for indenter in (_box(3 * MM, 5 * MM), _box(5 * MM, 3 * MM))
    )
    return [*validity_laws(along_y, along_x), swapped(along_y, along_x, SAME)]


def _box(width: float, length: float) -> Indenter:
    return shapes.box(width, length, 0.5 * MM)


def shift_by_a_cell(solver: Solver) -> list[Law]:
    """Pressed one element further, the deformation under the indenter moves by one node."""
    here, there = solver.many(
        [Scene(SPHERE, PRESS, GEL), Scene(SPHERE, press([0.5 * MM, 1 * MM, 1.5 * MM], at=(MM, 0)))]
    )
    near, far = here.surface[-1, 7:14, 7:14], there.surface[-1, 8:15, 7:14]
    # The sides are 10 and 9 mm away: an effect of exp(-0.78 * 9 / 4), about 0.1 %.
    return [
        *validity_laws(here, there, det_f=0.5),
        at_most("force", abs(push(there)[-1] / push(here)[-1] - 1), 0.005),
        at_most("surface: |du| / |u|", difference(near, far), 0.01),
    ]


def _alone(solver: Solver, scenes: list[Scene]) -> list[Law]:
    batched = zip(scenes, solver.many(scenes), strict=True)
    return [law for scene, result in batched for law in alike(solver.one(scene), result)]


def batch_against_alone(solver: Solver) -> list[Law]:
    """Different presses solved in one batch equal the presses solved alone, bit for bit."""
    scenes = [
        Scene(SPHERE, PRESS, PAD),
        Scene(shapes.flat_punch(2 * MM, 0.5 * MM), press([0.3 * MM]), PAD),
        Scene(SPHERE, press([0.9 * MM], at=(MM, 0.0)), replace(PAD, modulus=1e6, poisson=0.3)),
    ]
    return _alone(solver, scenes)


def batch_with_friction(solver: Solver) -> list[Law]:
    """The same with friction, where the memory of contact points must not mix between presses."""
    motion = press([0.6 * MM], shear=0.3 * MM, steps=2)
    scenes = [
        Scene(SPHERE, motion, PAD, Effects(friction=Friction(coefficient)))
        for coefficient in (0.2, 0.9)
    ]
    return _alone(solver, scenes)


def repeats(solver: Solver) -> list[Law]:
    """The same scene solved twice gives identical bits."""
    scene = Scene(SPHERE, PRESS, PAD)
    return alike(solver.one(scene), solver.one(scene))


def layer_against_fem(solver: Solver) -> list[Law]:
    """At 0.2 and 0.3 mm the linear layer and the finite elements agree within 2 %."""
    scene = Scene(SPHERE, press([0.2 * MM, 0.3 * MM]), MAT)
    fem = solver.one(scene, spacing=0.5 * MM)
    layer = simulate(scene, Layer())
    # Large strain adds 0.7 % at 0.3 mm, elements of 0.5 mm on a contact of 1 mm radius add 1 %.
    return [
        *validity_laws(fem, det_f=0.5),
        at_most("force", difference(fem.force, layer.force), 0.02),
    ]


def finer_mesh(solver: Solver) -> list[Law]:
    """Halving the elements from 1 to 0.5 mm changes the force by no more than 2 %."""
    coarse, fine = (
        solver.one(Scene(SPHERE, press([0.75 * MM, 1.5 * MM]), MAT), spacing=spacing)
        for spacing in (1 * MM, 0.5 * MM)
    )
    # Linear elements: the error decreases with the square of the spacing; it is 0.4 % at 1 mm and
    # 1.5 mm deep, more where the contact spans only two elements.
    return [
        *validity_laws(coarse, fine, det_f=0.5),
        at_most("force at 1.5 mm", abs(push(fine)[-1] / push(coarse)[-1] - 1), 0.02),
        at_least("layers of the fine mesh", fine.record["mesh"]["cells"][2], 8),
    ]


def torque_of_a_centred_press(solver: Solver) -> list[Law]:
    """A centred press has no torque about its tip."""
    result = solver.one(Scene(SPHERE, PRESS))
    lever = np.abs(result.wrench[:, 3:]).max() / push(result).max()
    # A lever of a thousandth of the contact radius (3 mm).
    return [*validity_laws(result, det_f=0.5), at_most("torque / force [m]", float(lever), 3e-6)]
