"""Friction: shear, reversal and slip; every contact point obeys Coulomb's law in every frame."""

from __future__ import annotations

import math

import numpy as np

from benchmarks.hard_cases import laws as law
from benchmarks.hard_cases.cases.bodies import MAT, MM, PAD, ball, way
from benchmarks.hard_cases.laws import Array, Law, push
from benchmarks.hard_cases.solver import Case, case
from sim.result import Result
from sim.scene import Body, Friction, Motion, Scene, press

LOOP = press([1 * MM], shear=1 * MM, steps=5)
# Frames of `LOOP` at the end of the shear and of its return.
ASIDE, BACK = 10, 15
# Work is summed by the trapezoid rule over about 50 steps of a loop: an error of at most 1 %.
QUADRATURE = 0.01
COSINE = math.sqrt(0.5)
ASIDE_2, BELOW = (0.3, 0.0, -0.6), (0.0, 0.0, -0.6)
# Small steps back and forth [mm].
SWAY = [0.05, 0.1, 0.15, 0.2, 0.25, 0.2, 0.15, 0.1, 0.05, 0.0]
SWAY += [-value for value in SWAY]


def _rubbed(coefficient: float, motion: Motion = LOOP, body: Body = MAT) -> Scene:
    return ball(motion, body, friction=Friction(coefficient))


def _sheared(coefficient: float, depth: float, shear: float, angle: float = 0.0) -> Scene:
    return _rubbed(coefficient, press([depth * MM], shear=shear * MM, angle=angle, steps=3))


def _drag(result: Result, frame: int) -> float:
    """Return the force that drags the body along +x over the force that presses it."""
    return float(result.force[frame, 0] / -result.force[frame, 2])


def _passive(result: Result) -> list[Law]:
    return [law.slides(result), law.dissipates(result, QUADRATURE), law.lets_go(result)]


def _loop(says: str, coefficient: float, least: float, pull: float = 1e-6) -> Case:
    return case(
        f"1 mm of shear and back at mu {coefficient:g}: {says}.",
        [_rubbed(coefficient)],
        lambda result: [
            *_passive(result),
            law.at_least("shear / push after 1 mm", _drag(result, ASIDE), least),
            # Ploughing: the sphere's front flank, with an average slope of 15 degrees, adds to mu.
            law.at_most("shear / push after 1 mm", _drag(result, ASIDE), coefficient + 0.25),
            law.at_least("sheared the other way after the return", -_drag(result, BACK), 0.0),
        ],
        det_f=0.3,
        pull=pull,
    )


def _closes(result: Result) -> list[Law]:
    rounds = result.force[2:].reshape(3, len(SWAY), 3)
    x = np.array(SWAY) * MM
    lost = [_area(np.append(x, x[0]), np.append(one[:, 0], one[0, 0])) for one in rounds[1:]]
    return [
        law.slides(result),
        law.dissipates(result, QUADRATURE),
        # Masing: a steady cycle forgets the first loading. Points at the rim of the contact come
        # and go, and creep towards the cycle: 0.03 % on uniform elements, 0.5 % on graded ones.
        law.at_most("third round against second", law.difference(rounds[1], rounds[2]), 0.01),
        law.at_least("work lost by a round / its largest", min(lost) / max(lost), 0.9),
    ]


def _area(x: Array, force: Array) -> float:
    """Return the work around a closed loop [J] by the trapezoid rule."""
    return float(((force[1:] + force[:-1]) / 2 * np.diff(x)).sum())


def _turned(straight: Result, turned: Result) -> list[Law]:
    along = (turned.force[:, 0] + turned.force[:, 1]) * COSINE
    across = (turned.force[:, 1] - turned.force[:, 0]) * COSINE
    back = np.stack([along, across, turned.force[:, 2]], axis=1)
    # The square body and its elements are not round: sides are nearer by a factor of sqrt 2, and
    # about 20 contact points lie differently.
    return [
        law.slides(straight, turned),
        law.at_most("force", law.difference(straight.force, back), 0.03),
        law.at_most("force across", float(np.abs(across).max()) / np.abs(along).max(), 1e-3),
    ]


def _stiffens(stuck: Result, free: Result) -> list[Law]:
    ratio = float(push(stuck)[-1] / push(free)[-1])
    # Two independent element families give 2.18 to 2.19 N against 1.956 N on the 20 mm gel: 1.117.
    return [
        law.slides(stuck),
        law.at_least("stiffening", ratio, 1.05),
        law.at_most("stiffening", ratio, 1.18),
    ]


CASES: dict[str, Case] = {
    "shear-friction-0": case(
        "Friction with coefficient 0 is frictionless: same forces, no work lost, 1 mm of shear.",
        [_rubbed(0.0), ball(LOOP, MAT)],
        lambda rubbed, free: [
            law.slides(rubbed),
            law.same_force("against no friction at all", free, rubbed, law.SAME),
            law.at_most("lost around the loop", abs(rubbed.quality.energy_gap[-1]), QUADRATURE),
            law.lets_go(rubbed),
        ],
        det_f=0.4,
        # Stiff contact: with soft contact, multiplier updates at every frame move the skin without
        # work of the tip, 1 % of it at the default, 0.3 % here.
        penalty=1000.0,
    ),
    "shear-friction-0-3": _loop("all slips; Coulomb at every point, work is lost", 0.3, 0.3),
    "shear-friction-0-8": _loop("part sticks, part slips", 0.8, 0.55),
    # At the trailing edge the sphere's flank is steeper than mu = 1: sticking points there are
    # pulled up by mu sin - cos of the slope, at a small pressure: 1 % of the largest.
    "shear-friction-2": _loop("nearly all sticks", 2.0, 0.55, pull=0.03),
    "lifted-while-it-slips": case(
        "Lifted during full slip: the friction limit follows the pressure of the same moment.",
        [
            _rubbed(
                0.3,
                way((0, 0, 0), BELOW, ASIDE_2, *((0.3, 0, z) for z in (-0.5, -0.4, -0.2, 0))),
                PAD,
            )
        ],
        lambda result: [
            *_passive(result),
            # All but the last ring slips after half a contact radius: almost mu.
            law.at_least("shear / push", _drag(result, 2), 0.2),
            law.at_most("shear / push", _drag(result, 2), 0.4),
        ],
    ),
    "friction-rises-with-its-coefficient": case(
        "More friction gives more shear force and more push for the same path: mu 0, 0.1, 0.3, 1.",
        [_sheared(coefficient, 0.6, 0.4) for coefficient in (0.0, 0.1, 0.3, 1.0)],
        lambda *results: [
            law.slides(*results),
            law.rises("shear force with mu", [result.force[6, 0] for result in results]),
            law.rises("push with mu", [push(result)[3] for result in results]),
        ],
        det_f=None,
    ),
    "shear-in-few-or-many-frames": case(
        "The same shear in 2 or in 10 frames: friction depends on the path, not on the frames.",
        [_rubbed(0.3, press([1 * MM], shear=1 * MM, steps=steps)) for steps in (2, 10)],
        # Steps are at most a fortieth of the thickness, independently of frames: paths differ in
        # the positions of the steps, and slip per step is first-order accurate (1/10 of the shear
        # a step).
        lambda few, many: [
            law.slides(few, many),
            law.at_most(
                "forces at the corners", law.difference(few.force[::2], many.force[::10]), 0.02
            ),
        ],
        det_f=None,
    ),
    "stick-slip-reversals": case(
        "Small steps back and forth: from the second round on the loop closes and dissipates work.",
        [_rubbed(0.3, way((0, 0, 0), (0, 0, -0.5), *((x, 0, -0.5) for x in SWAY * 3)), PAD)],
        _closes,
    ),
    "light-press-long-slide": case(
        "Pressed 0.15 mm and dragged 3 mm, it slips everywhere, and shear over push becomes mu.",
        [_rubbed(0.4, way((-1.5, 0, 0), *((x / 2, 0, -0.15) for x in range(-3, 4))), PAD)],
        # A light press ploughs little: its flank is 0.15 mm high on a contact of 0.7 mm, and points
        # enter in front and leave behind, which tilts the mean normal by a few degrees.
        lambda result: [
            law.slides(result),
            law.dissipates(result, QUADRATURE),
            law.at_most(
                "|shear / push - mu|",
                np.abs(result.force[4:, 0] / push(result)[4:] - 0.4).max(),
                0.05,
            ),
        ],
        spacing=0.67 * MM,
    ),
    "shear-mirrors": case(
        "Shear to -x is the mirror image of shear to +x.",
        [_sheared(0.5, 0.6, shear) for shear in (0.4, -0.4)],
        # Each state is accepted with a residual of 1e-4, and accumulated slip is remembered.
        lambda right, left: [
            law.slides(right, left),
            law.mirrored(right, left, 2e-3),
            law.at_most("force", law.difference(right.force, left.force * [-1, 1, 1]), 1e-3),
        ],
        det_f=None,
    ),
    "shear-along-y": case(
        "Shear along y is shear along x with x and y exchanged.",
        [_sheared(0.5, 0.6, 0.4, angle) for angle in (0.0, math.pi / 2)],
        lambda along_x, along_y: [
            law.slides(along_x, along_y),
            law.swapped(along_x, along_y, 2e-3),
            law.at_most("force", law.difference(along_x.force, along_y.force[:, [1, 0, 2]]), 1e-3),
        ],
        det_f=None,
    ),
    "shear-along-the-diagonal": case(
        "Shear at 45 degrees gives the rotated force of shear along x.",
        [_sheared(0.5, 0.8, 0.5, angle) for angle in (0.0, math.pi / 4)],
        _turned,
        det_f=None,
    ),
    "full-stick-stiffens": case(
        "A press that cannot slip (mu 10) needs a tenth more force than one that slips freely.",
        [
            _rubbed(10.0, press([0.5 * MM, 1.0 * MM, 1.5 * MM])),
            ball(press([0.5 * MM, 1.0 * MM, 1.5 * MM]), MAT),
        ],
        _stiffens,
        det_f=0.4,
    ),
    "slides-off-the-rim": case(
        "Dragged outwards over the rim until contact is lost sideways: no force remains.",
        [_rubbed(0.5, way((2, 0, 0), *((x, 0, -0.8) for x in (2, 3, 4, 5, 6, 7, 9))), PAD)],
        _passive,
        det_f=0.3,
    ),
    "shear-of-a-sunk-start": case(
        "A motion that begins 0.6 mm inside sticks like one that first pressed straight down.",
        [_rubbed(0.5, way(*start, BELOW, ASIDE_2)) for start in ([], [(0, 0, 0)])],
        lambda sunk, pressed: [
            law.slides(sunk, pressed),
            law.same_end("force", pressed, sunk, 2e-3),
        ],
        det_f=None,
    ),
}
