"""Friction: shear, reversal and slip; every contact point obeys Coulomb's law in every frame."""

from __future__ import annotations

import math

import numpy as np

from benchmarks.hard_cases.cases.bodies import MAT, MM, PAD, SPHERE
from benchmarks.hard_cases.laws import (
    SAME,
    Law,
    at_least,
    at_most,
    difference,
    dissipates,
    lets_go,
    mirrored,
    push,
    rises,
    same_end,
    same_force,
    slides,
    swapped,
    validity_laws,
)
from benchmarks.hard_cases.solver import Solver
from sim.result import Result
from sim.scene import Effects, Friction, Motion, Scene, press, through

LOOP = press([1 * MM], shear=1 * MM, steps=5)
# Frames of `LOOP` at the end of the shear and of its return.
ASIDE, BACK = 10, 15
# Work is summed by the trapezoid rule over about 50 steps of a loop: an error of at most 1 %.
QUADRATURE = 0.01


def _rubbed(coefficient: float, motion: Motion = LOOP) -> Scene:
    return Scene(SPHERE, motion, MAT, Effects(friction=Friction(coefficient)))


def _drag(result: Result, frame: int) -> float:
    """Return the force that drags the body along +x over the force that presses it."""
    return float(result.force[frame, 0] / -result.force[frame, 2])


def _loop(solver: Solver, coefficient: float, least: float, pull: float = 1e-6) -> list[Law]:
    result = solver.one(_rubbed(coefficient))
    return [
        *validity_laws(result, det_f=0.3, pull=pull),
        slides(result),
        dissipates(result, QUADRATURE),
        lets_go(result),
        at_least("shear / push after 1 mm", _drag(result, ASIDE), least),
        # Ploughing: the sphere's front flank, with an average slope of 15 degrees, adds to mu.
        at_most("shear / push after 1 mm", _drag(result, ASIDE), coefficient + 0.25),
        at_least("sheared the other way after the return", -_drag(result, BACK), 0.0),
    ]


def shear_friction_0(solver: Solver) -> list[Law]:
    """Friction with coefficient 0 is frictionless: same forces, no work lost, 1 mm of shear."""
    # Stiff contact: with soft contact, multiplier updates at every frame move the skin without
    # work of the tip, 1 % of it at the default, 0.3 % here.
    rubbed = solver.one(_rubbed(0.0), penalty=1000.0)
    free = solver.one(Scene(SPHERE, LOOP, MAT), penalty=1000.0)
    return [
        *validity_laws(rubbed, free, det_f=0.4),
        slides(rubbed),
        same_force("against no friction at all", free, rubbed, SAME),
        at_most("lost around the loop", abs(rubbed.quality.energy_gap[-1]), QUADRATURE),
        lets_go(rubbed),
    ]


def shear_friction_0_3(solver: Solver) -> list[Law]:
    """1 mm of shear and back at mu 0.3: all slips; Coulomb at every point, work is lost."""
    return _loop(solver, 0.3, 0.3)


def shear_friction_0_8(solver: Solver) -> list[Law]:
    """1 mm of shear and back at mu 0.8: part sticks, part slips."""
    return _loop(solver, 0.8, 0.55)


def shear_friction_2(solver: Solver) -> list[Law]:
    """1 mm of shear and back at mu 2: nearly all sticks."""
    # At the trailing edge the sphere's flank is steeper than mu = 1: sticking points there are
    # pulled up by mu sin - cos of the slope, at a small pressure: 1 % of the largest.
    return _loop(solver, 2.0, 0.55, pull=0.03)


def lifted_while_it_slips(solver: Solver) -> list[Law]:
    """Lifted during full slip: the friction limit follows the pressure of the same moment."""
    points = [(0.0, 0.0, 0.0), (0.0, 0.0, -0.6 * MM), (0.3 * MM, 0.0, -0.6 * MM)]
    points += [(0.3 * MM, 0.0, z * MM) for z in (-0.5, -0.4, -0.2, 0.0)]
    scene = Scene(SPHERE, through(points, speed=10 * MM), PAD, Effects(friction=Friction(0.3)))
    result = solver.one(scene)
    return [
        *validity_laws(result, det_f=0.5),
        slides(result),
        dissipates(result, QUADRATURE),
        lets_go(result),
        # All but the last ring slips after half a contact radius: almost mu.
        at_least("shear / push", _drag(result, 2), 0.2),
        at_most("shear / push", _drag(result, 2), 0.4),
    ]


def friction_rises_with_its_coefficient(solver: Solver) -> list[Law]:
    """More friction gives more shear force and more push for the same path: mu 0, 0.1, 0.3, 1."""
    motion = press([0.6 * MM], shear=0.4 * MM, steps=3)
    scenes = [_rubbed(coefficient, motion) for coefficient in (0.0, 0.1, 0.3, 1.0)]
    results = solver.many(scenes)
    return [
        slides(*results),
        rises("shear force with mu", [result.force[6, 0] for result in results]),
        rises("push with mu", [push(result)[3] for result in results]),
    ]


def shear_in_few_or_many_frames(solver: Solver) -> list[Law]:
    """The same shear in 2 or in 10 frames: friction depends on the path, not on the frames."""
    few, many = (
        solver.one(_rubbed(0.3, press([1 * MM], shear=1 * MM, steps=steps))) for steps in (2, 10)
    )
    # Steps are at most a fortieth of the thickness, independently of frames: paths differ in the
    # positions of the steps, and slip per step is first-order accurate (1/10 of the shear a step).
    return [
        slides(few, many),
        at_most("forces at the corners", difference(few.force[::2], many.force[::10]), 0.02),
    ]


def stick_slip_reversals(solver: Solver) -> list[Law]:
    """Small steps back and forth: from the second round on the loop closes and dissipates work."""
    sway = [0.05, 0.1, 0.15, 0.2, 0.25, 0.2, 0.15, 0.1, 0.05, 0.0]
    sway += [-value for value in sway]
    points = [(0.0, 0.0, 0.0), (0.0, 0.0, -0.5 * MM)]
    points += [(value * MM, 0.0, -0.5 * MM) for value in sway * 3]
    scene = Scene(SPHERE, through(points, speed=10 * MM), PAD, Effects(friction=Friction(0.3)))
    result = solver.one(scene)
    rounds = result.force[2:].reshape(3, len(sway), 3)
    x = np.array(sway) * MM
    lost = [_area(np.append(x, x[0]), np.append(one[:, 0], one[0, 0])) for one in rounds[1:]]
    return [
        *validity_laws(result, det_f=0.5),
        slides(result),
        dissipates(result, QUADRATURE),
        # Masing: a steady cycle forgets the first loading. Points at the rim of the contact come
        # and go, and creep towards the cycle: 0.03 % on uniform elements, 0.5 % on graded ones.
        at_most("third round against second", difference(rounds[1], rounds[2]), 0.01),
        at_least("work lost by a round / its largest", min(lost) / max(lost), 0.9),
    ]


def _area(x: np.ndarray, force: np.ndarray) -> float:
    """Return the work around a closed loop [J] by the trapezoid rule."""
    return float(((force[1:] + force[:-1]) / 2 * np.diff(x)).sum())


def light_press_long_slide(solver: Solver) -> list[Law]:
    """Pressed 0.15 mm and dragged 3 mm, it slips everywhere, and shear over push becomes mu."""
    points = [(-1.5 * MM, 0.0, 0.0), (-1.5 * MM, 0.0, -0.15 * MM)]
    points += [(x * MM, 0.0, -0.15 * MM) for x in (-1.0, -0.5, 0.0, 0.5, 1.0, 1.5)]
    scene = Scene(SPHERE, through(points, speed=10 * MM), PAD, Effects(friction=Friction(0.4)))
    result = solver.one(scene, spacing=0.67 * MM)
    ratio = result.force[4:, 0] / push(result)[4:]
    # A light press ploughs little: its flank is 0.15 mm high on a contact of 0.7 mm, and points
    # enter in front and leave behind, which tilts the mean normal by a few degrees.
    return [
        *validity_laws(result, det_f=0.5),
        slides(result),
        dissipates(result, QUADRATURE),
        at_most("|shear / push - mu|", np.abs(ratio - 0.4).max(), 0.05),
    ]


def shear_mirrors(solver: Solver) -> list[Law]:
    """Shear to -x is the mirror image of shear to +x."""
    right, left = (
        solver.one(_rubbed(0.5, press([0.6 * MM], shear=way * MM, steps=3))) for way in (0.4, -0.4)
    )
    turned = left.force * np.array([-1, 1, 1])
    # Each state is accepted with a residual of 1e-4, and accumulated slip is remembered.
    return [
        slides(right, left),
        mirrored(right, left, 2e-3),
        at_most("force", difference(right.force, turned), 1e-3),
    ]


def shear_along_y(solver: Solver) -> list[Law]:
    """Shear along y is shear along x with x and y exchanged."""
    along_x, along_y = (
        solver.one(_rubbed(0.5, press([0.6 * MM], shear=0.4 * MM, angle=angle, steps=3)))
        for angle in (0.0, math.pi / 2)
    )
    return [
        slides(along_x, along_y),
        swapped(along_x, along_y, 2e-3),
        at_most("force", difference(along_x.force, along_y.force[:, [1, 0, 2]]), 1e-3),
    ]


def shear_along_the_diagonal(solver: Solver) -> list[Law]:
    """Shear at 45 degrees gives the rotated force of shear along x."""
    straight, turned = (
        solver.one(_rubbed(0.5, press([0.8 * MM], shear=0.5 * MM, angle=angle, steps=3)))
        for angle in (0.0, math.pi / 4)
    )
    cosine = math.sqrt(0.5)
    along = (turned.force[:, 0] + turned.force[:, 1]) * cosine
    across = (turned.force[:, 1] - turned.force[:, 0]) * cosine
    back = np.stack([along, across, turned.force[:, 2]], axis=1)
    # The square body and its elements are not round: sides are nearer by a factor of sqrt 2, and
    # about 20 contact points lie differently.
    return [
        slides(straight, turned),
        at_most("force", difference(straight.force, back), 0.03),
        at_most("force across", float(np.abs(across).max()) / np.abs(along).max(), 1e-3),
    ]


def full_stick_stiffens(solver: Solver) -> list[Law]:
    """A press that cannot slip (mu 10) needs a tenth more force than one that slips freely."""
    motion = press([0.5 * MM, 1.0 * MM, 1.5 * MM])
    stuck = solver.one(_rubbed(10.0, motion))
    free = solver.one(Scene(SPHERE, motion, MAT))
    ratio = float(push(stuck)[-1] / push(free)[-1])
    # Two independent element families give 2.18 to 2.19 N against 1.956 N on the 20 mm gel: 1.117.
    return [
        *validity_laws(stuck, free, det_f=0.4),
        slides(stuck),
        at_least("stiffening", ratio, 1.05),
        at_most("stiffening", ratio, 1.18),
    ]


def slides_off_the_rim(solver: Solver) -> list[Law]:
    """Dragged outwards over the rim until contact is lost sideways: no force remains."""
    points = [(2.0 * MM, 0.0, 0.0), (2.0 * MM, 0.0, -0.8 * MM)]
    points += [(x * MM, 0.0, -0.8 * MM) for x in (3.0, 4.0, 5.0, 6.0, 7.0, 9.0)]
    scene = Scene(SPHERE, through(points, speed=10 * MM), PAD, Effects(friction=Friction(0.5)))
    result = solver.one(scene)
    return [
        *validity_laws(result, det_f=0.3),
        slides(result),
        dissipates(result, QUADRATURE),
        lets_go(result),
    ]


def shear_of_a_sunk_start(solver: Solver) -> list[Law]:
    """A motion that begins 0.6 mm inside sticks like one that first pressed straight down."""
    low, aside = (0.0, 0.0, -0.6 * MM), (0.3 * MM, 0.0, -0.6 * MM)
    sunk = solver.one(_rubbed(0.5, through([low, aside], speed=10 * MM)))
    pressed = solver.one(_rubbed(0.5, through([(0.0, 0.0, 0.0), low, aside], speed=10 * MM)))
    return [slides(sunk, pressed), same_end("force", pressed, sunk, 2e-3)]
