"""Friction: shear, reversal and slip; every contact point obeys Coulomb's law in every frame."""

import math

import numpy as np

from benchmarks.hard_cases import laws as law
from benchmarks.hard_cases.bodies import MAT, MM, PAD, ball, down, way
from benchmarks.hard_cases.laws import Laws, push
from benchmarks.hard_cases.solver import Case, case
from sim.result import Result
from sim.scene import Body, Friction, Motion, Scene

LOOP = down(1, shear=1, steps=5)
# Frames of `LOOP` at the end of the shear and of its return.
ASIDE, BACK = 10, 15
# Work is summed by the trapezoid rule over about 50 steps of a loop: an error of at most 1 %.
QUADRATURE = 0.01
ASIDE_2, BELOW = (0.3, 0.0, -0.6), (0.0, 0.0, -0.6)
# Small steps back and forth [mm].
SWAY = [0.05, 0.1, 0.15, 0.2, 0.25, 0.2, 0.15, 0.1, 0.05, 0.0]
SWAY += [-value for value in SWAY]
DRAGGED = way((-1.5, 0, 0), *((x / 2, 0, -0.15) for x in range(-3, 4)))


def _rubbed(coefficient: float, motion: Motion = LOOP, body: Body = MAT) -> Scene:
    return ball(motion, body, friction=Friction(coefficient))


def _sheared(coefficient: float, depth: float, shear: float, angle: float = 0.0) -> Scene:
    return _rubbed(coefficient, down(depth, shear=shear, angle=angle, steps=3))


def _drag(result: Result, frame: int) -> float:
    """Return the force that drags the body along +x over the force that presses it."""
    return float(result.force[frame, 0] / push(result)[frame])


# Stiff contact: with soft contact, multiplier updates at every frame move the skin without work of
# the tip, 1 % of it at the default, 0.3 % here.
@case(_rubbed(0.0), ball(LOOP, MAT), det_f=0.4, penalty=1000.0)
def shear_friction_0(rubbed: Result, free: Result) -> Laws:
    """Friction with coefficient 0 is frictionless: same forces, no work lost, 1 mm of shear."""
    yield law.same_force("against no friction at all", free, rubbed)
    yield law.conserves(rubbed, QUADRATURE, "lost around the loop")


def _loop(coefficient: float, says: str, least: float, pull: float = 1e-6) -> Case:
    says = f"1 mm of shear and back at mu {coefficient:g}: {says}."

    @case(_rubbed(coefficient), says=says, det_f=0.3, pull=pull)
    def sheared(result: Result) -> Laws:
        yield law.dissipates(result, QUADRATURE)
        yield law.at_least("shear / push after 1 mm", _drag(result, ASIDE), least)
        # Ploughing: the sphere's front flank, with an average slope of 15 degrees, adds to mu.
        yield law.at_most("shear / push after 1 mm", _drag(result, ASIDE), coefficient + 0.25)
        yield law.at_least("sheared the other way after the return", -_drag(result, BACK), 0.0)

    return sheared


shear_friction_0_3 = _loop(0.3, "all slips; Coulomb at every point, work is lost", 0.3)
shear_friction_0_8 = _loop(0.8, "part sticks, part slips", 0.55)
# At the trailing edge the sphere's flank is steeper than mu = 1: sticking points there are pulled
# up by mu sin - cos of the slope, at a small pressure: 1 % of the largest.
shear_friction_2 = _loop(2.0, "nearly all sticks", 0.55, pull=0.03)


@case(_rubbed(0.3, way((0, 0, 0), BELOW, *((0.3, 0, z) for z in (-0.6, -0.5, -0.4, -0.2, 0))), PAD))
def lifted_while_it_slips(result: Result) -> Laws:
    """Lifted during full slip: the friction limit follows the pressure of the same moment."""
    yield law.dissipates(result, QUADRATURE)
    # All but the last ring slips after half a contact radius: almost mu.
    yield law.at_least("shear / push", _drag(result, 2), 0.2)
    yield law.at_most("shear / push", _drag(result, 2), 0.4)


@case(*(_sheared(coefficient, 0.6, 0.4) for coefficient in (0.0, 0.1, 0.3, 1.0)))
def friction_rises_with_its_coefficient(*results: Result) -> Laws:
    """More friction gives more shear force and more push for the same path: mu 0, 0.1, 0.3, 1."""
    yield law.rises("shear force with mu", [result.force[6, 0] for result in results])
    yield law.rises("push with mu", [push(result)[3] for result in results])


@case(*(_rubbed(0.3, down(1, shear=1, steps=steps)) for steps in (2, 10)))
def shear_in_few_or_many_frames(few: Result, many: Result) -> Laws:
    """The same shear in 2 or in 10 frames: friction depends on the path, not on the frames."""
    # Steps are at most a fortieth of the thickness, independently of frames: paths differ in the
    # positions of the steps, and slip per step is first-order accurate (1/10 of the shear a step).
    apart = law.difference(few.force[::2], many.force[::10])
    yield law.at_most("forces at the corners", apart, 0.02)


@case(_rubbed(0.3, way((0, 0, 0), (0, 0, -0.5), *((x, 0, -0.5) for x in SWAY * 3)), PAD))
def stick_slip_reversals(result: Result) -> Laws:
    """Small steps back and forth: from the second round on the loop closes and dissipates work."""
    yield law.dissipates(result, QUADRATURE)
    _, second, third = result.force[2:].reshape(3, len(SWAY), 3)
    # Masing: a steady cycle forgets the first loading. Points at the rim of the contact come and
    # go, and creep towards the cycle: 0.03 % on uniform elements, 0.5 % on graded ones.
    yield law.at_most("third round against second", law.difference(second, third), 0.01)
    x = np.array([*SWAY, SWAY[0]]) * MM
    lost = [np.trapezoid(np.append(one[:, 0], one[0, 0]), x) for one in (second, third)]
    yield law.at_least("work lost by a round / its largest", min(lost) / max(lost), 0.9)


# A light press ploughs little: its flank is 0.15 mm high on a contact of 0.7 mm, and points enter
# in front and leave behind, which tilts the mean normal by a few degrees.
@case(_rubbed(0.4, DRAGGED, PAD), spacing=0.67 * MM)
def light_press_long_slide(result: Result) -> Laws:
    """Pressed 0.15 mm and dragged 3 mm, it slips everywhere, and shear over push becomes mu."""
    yield law.dissipates(result, QUADRATURE)
    drags = [_drag(result, frame) for frame in range(4, len(result.force))]
    yield law.at_most("|shear / push - mu|", max(abs(drag - 0.4) for drag in drags), 0.05)


# Each state is accepted with a residual of 1e-4, and accumulated slip is remembered.
@case(*(_sheared(0.5, 0.6, shear) for shear in (0.4, -0.4)))
def shear_mirrors(right: Result, left: Result) -> Laws:
    """Shear to -x is the mirror image of shear to +x."""
    yield law.mirrored(right, left, 2e-3)
    yield law.at_most("force", law.difference(right.force, left.force * [-1, 1, 1]), 1e-3)


@case(*(_sheared(0.5, 0.6, 0.4, angle) for angle in (0.0, math.pi / 2)))
def shear_along_y(along_x: Result, along_y: Result) -> Laws:
    """Shear along y is shear along x with x and y exchanged."""
    yield law.swapped(along_x, along_y, 2e-3)
    yield law.at_most("force", law.difference(along_x.force, along_y.force[:, [1, 0, 2]]), 1e-3)


@case(*(_sheared(0.5, 0.8, 0.5, angle) for angle in (0.0, math.pi / 4)))
def shear_along_the_diagonal(straight: Result, turned: Result) -> Laws:
    """Shear at 45 degrees gives the rotated force of shear along x."""
    x, y, z = turned.force.T
    along, across = (x + y) / math.sqrt(2), (y - x) / math.sqrt(2)
    back = np.stack([along, across, z], axis=1)
    # The square body and its elements are not round: sides are nearer by a factor of sqrt 2, and
    # about 20 contact points lie differently.
    yield law.at_most("force", law.difference(straight.force, back), 0.03)
    yield law.at_most("force across", np.abs(across).max() / np.abs(along).max(), 1e-3)


@case(_rubbed(10.0, down(0.5, 1.0, 1.5)), ball(down(0.5, 1.0, 1.5), MAT), det_f=0.4)
def full_stick_stiffens(stuck: Result, free: Result) -> Laws:
    """A press that cannot slip (mu 10) needs a tenth more force than one that slips freely."""
    ratio = push(stuck)[-1] / push(free)[-1]
    # Two independent element families give 2.18 to 2.19 N against 1.956 N on the 20 mm gel: 1.117.
    yield law.at_least("stiffening", ratio, 1.05)
    yield law.at_most("stiffening", ratio, 1.18)


@case(_rubbed(0.5, way((2, 0, 0), *((x, 0, -0.8) for x in (2, 3, 4, 5, 6, 7, 9))), PAD), det_f=0.3)
def slides_off_the_rim(result: Result) -> Laws:
    """Dragged outwards over the rim until contact is lost sideways: no force remains."""
    return [law.dissipates(result, QUADRATURE), law.lets_go(result)]


@case(*(_rubbed(0.5, way(*start, BELOW, ASIDE_2)) for start in ([], [(0, 0, 0)])))
def shear_of_a_sunk_start(sunk: Result, pressed: Result) -> Laws:
    """A motion that begins 0.6 mm inside sticks like one that first pressed straight down."""
    yield law.same_end(pressed, sunk, 2e-3)
