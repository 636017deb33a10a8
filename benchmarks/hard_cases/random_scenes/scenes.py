"""Random sensible scenes: scene i of a seed is reproducible, independently of the others.

The number decides the traits of a scene, so that every run has the same shares: a third inertia or
viscosity, a third a dome or a contact at the rim, a fifth an indenter of the paper with friction
and shear, and three in twenty an axis of symmetry, for a solver that shares no code.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

import numpy as np

from benchmarks.hard_cases.random_scenes.dice import Dice, rounded
from benchmarks.hard_cases.random_scenes.shapes import MM, draw_shape
from sim.errors import SceneError
from sim.indenters import NAMES, Indenter, named, shapes
from sim.scene import (
    Body,
    Effects,
    Friction,
    Gravity,
    Inertia,
    Motion,
    Scene,
    Viscosity,
    press,
    through,
)

# Default folder of STL files and counter-examples.
FOLDER = Path("build/hard-cases")
# Groups of scenes, which overlap; each with the numbers that belong to it.
GROUPS: dict[str, Callable[[int], bool]] = {
    "inertia or viscosity": lambda index: index % 3 == 0,
    "dome or rim": lambda index: index // 3 % 3 == 0,
    "paper's, friction and shear": lambda index: index % 5 == 0,
    "axis of symmetry": lambda index: index % 20 in (3, 8, 13),
}
TIMED, CURVED, PAPER, AXIAL = GROUPS
# Gels of the paper: thickness [m] and Poisson's ratio.
PAPER_GELS = {2.5 * MM: 0.48, 4.0 * MM: 0.45, 5.5 * MM: 0.40}


@dataclass(frozen=True, slots=True)
class Drawn:
    """One scene."""

    name: str
    """Seed and number, in the format of `--seed` and `--first`."""
    what: str
    """Description: indenter, place, motion and effects."""
    groups: tuple[str, ...]
    """Those of `GROUPS` that it belongs to."""
    scene: Scene


def drawn(seed: int, index: int, folder: Path = FOLDER) -> Drawn:
    """Return scene `index` of `seed`, writing required STL files to `folder`.

    Anything that is no scene, such as a shape beyond its limits, is drawn again.
    """
    groups = tuple(name for name, has in GROUPS.items() if has(index))
    for attempt in count():
        dice = Dice(seed, index, attempt)
        try:
            scene = _drawn(dice, groups, folder)
        except SceneError:
            continue
        return Drawn(f"{seed}/{index}", ", ".join(dice.words), groups, scene)
    raise AssertionError


def _drawn(dice: Dice, groups: tuple[str, ...], folder: Path) -> Scene:
    if AXIAL in groups:
        return _axial(dice, timed=TIMED in groups, curved=CURVED in groups)
    body, place = _body(dice), (0.0, 0.0)
    indenter, shear = draw_shape(dice, body.thickness / 4, folder), 0.0
    depth = body.thickness * dice.scaled(0.01, 0.4)
    effects = _effects(dice, timed=TIMED in groups)
    if PAPER in groups:
        thickness = dice.one_of([*PAPER_GELS])
        body = Body(thickness=thickness, poisson=PAPER_GELS[thickness])
        dice.words.clear()
        indenter = named(dice.kind(dict.fromkeys(NAMES, 1.0)))
        friction = Friction(dice.one_of([0.2, 0.5, 0.9]))
        dice.words.append(f"friction {friction.coefficient:g}")
        effects = replace(effects, friction=friction)
        depth, shear = thickness * dice.even(0.1, 0.35), MM * dice.even(0.25, 1.0)
    if CURVED in groups:
        body, place = _curved(dice, body)
    elif dice.chance(0.4):
        dice.words.append("aside")
        place = (
            rounded(body.size_x * dice.even(-0.3, 0.3)),
            rounded(body.size_y * dice.even(-0.3, 0.3)),
        )
    return Scene(indenter, _motion(dice, body, depth, shear, place, effects), body, effects)


def _body(dice: Dice) -> Body:
    """Return a flat gel 0.5 to 20 mm thick."""
    thickness = dice.one_of([4.0 * MM, 4.0 * MM, rounded(MM * dice.scaled(0.5, 20.0))])
    size_x, size_y = (rounded(thickness * dice.scaled(1.5, 6.0)) for _ in range(2))
    return Body(
        size_x, size_x if dice.chance(0.4) else size_y, thickness,
        modulus=dice.scaled(1e4, 3e6),
        poisson=dice.weighted({0.45: 4, 0.49: 2, 0.3: 1, 0.0: 0.3, 0.499: 1, 0.4999: 0.2}),
    )  # fmt: skip


def _curved(dice: Dice, body: Body) -> tuple[Body, tuple[float, float]]:
    """Return a gel that is domed, round, or both, and a place: anywhere on a dome, or at a rim."""
    half_x, half_y = body.size_x / 2, body.size_y / 2
    kind = dice.kind({"dome": 3, "round dome": 2, "rim": 2, "round rim": 2, "corner": 1})
    if "round" in kind:
        body = replace(body, footprint="ellipse")
    turn, far = dice.even(0.0, math.tau), dice.even(0.0, 0.5)
    if "dome" in kind:
        corner = max(half_x, half_y) if "round" in kind else math.hypot(half_x, half_y)
        drop = dice.even(0.1, 0.6) * body.thickness
        body = replace(body, dome_radius=rounded((corner**2 + drop**2) / (2 * drop), 6))
    elif kind == "corner":
        turn, far = math.atan2(half_y, half_x), math.sqrt(2) * dice.even(0.8, 1.0)
    else:
        far = dice.even(0.75, 1.05)
        turn = turn if kind == "round rim" else dice.one_of([0.0, math.pi / 2])
    return body, (rounded(far * half_x * math.cos(turn)), rounded(far * half_y * math.sin(turn)))


def _effects(dice: Dice, *, timed: bool) -> Effects:
    friction = viscosity = inertia = gravity = None
    if dice.chance(0.35):
        friction = Friction(dice.one_of([0.1, 0.3, 0.8, rounded(dice.even(0.0, 2.0))]))
        dice.words.append(f"friction {friction.coefficient:g}")
    if timed:
        kind = dice.weighted({"inertia": 3, "viscosity": 3, "both": 1})
        if kind != "inertia":
            branches = range(dice.whole(1, 2))
            ratios = tuple(dice.scaled(0.1, 3.0) for _ in branches)
            viscosity = Viscosity(ratios, tuple(dice.scaled(1e-2, 10.0) for _ in branches))
        inertia = None if kind == "viscosity" else Inertia()
    elif dice.chance(0.1):
        gravity = Gravity(dice.one_of([(0.0, 0.0, -9.81), (0.0, 0.0, 9.81), (9.81, 0.0, 0.0)]))
    effects = Effects(friction, viscosity, inertia, gravity)
    dice.words += [name for name in effects.key if name != "friction"]
    return effects


def _speed(dice: Dice, effects: Effects) -> float:
    """Return a speed [m/s]; with inertia up to 3 m/s, where waves matter."""
    return dice.scaled(0.03, 3.0) if effects.inertia else dice.scaled(1e-3, 0.1)


def _motion(
    dice: Dice, body: Body, depth: float, shear: float, place: tuple[float, float], effects: Effects
) -> Motion:
    """Return a press, a cycle, a hold, a shear and its return, or a slide; from the surface on.

    A shear of 0 is drawn where there is one.
    """
    x, y = place
    kind = "shear" if shear else dice.kind({"press": 5, "cycle": 2, "hold": 2, "shear": 3})
    depth, away, speed = rounded(depth), rounded(0.1 * body.thickness), _speed(dice, effects)
    if effects.friction is not None:
        depth = min(depth, rounded(body.thickness / 3))
    levels, over = [0.0, -depth], [(x, y)] * 2
    if kind == "press":
        steps = dice.whole(1, 3)
        levels = [-rounded(depth * step / steps) for step in range(steps + 1)]
    elif kind == "cycle":
        levels = [0.0, -depth, -rounded(depth / 2), 0.0, away]
    elif kind == "shear":
        aside = shear or min(rounded(depth * dice.scaled(0.1, 1.5)), rounded(body.thickness / 3))
        angle = dice.one_of([0.0, math.pi / 2, dice.even(0.0, math.tau)])
        moved = rounded(x + aside * math.cos(angle), 6), rounded(y + aside * math.sin(angle), 6)
        levels, over = [0.0, -depth, -depth, away], [(x, y), (x, y), moved, moved]
    over += over[-1:] * (len(levels) - len(over))
    inside = body.covers(np.asarray(x), np.asarray(y))
    ground = body.height(x, y) if inside else 0.0
    points = [
        (*at, max(rounded(level + ground, 6), -0.89 * body.thickness))
        for at, level in zip(over, levels, strict=True)
    ]
    moving = through(points, speed=speed)
    if kind != "hold":
        return moving
    return Motion((*moving.tip, moving.tip[-1]), (*moving.time, 2 * moving.time[-1]))


def _axial(dice: Dice, *, timed: bool, curved: bool) -> Scene:
    """Return a press along the axis of a disc, flat or domed: elastic, with friction or inertia."""
    dice.words.append("axial")
    thickness = dice.one_of([4.0 * MM, rounded(MM * dice.scaled(0.5, 20.0))])
    unit, size = thickness / 4, rounded(thickness * dice.scaled(3.0, 7.0))
    poisson = dice.one_of([0.45, 0.45, 0.3, 0.49, 0.499])
    body = Body(size, size, thickness, dice.scaled(1e4, 3e6), poisson, footprint="ellipse")
    if curved:
        drop = thickness * dice.even(0.1, 0.5)
        body = replace(body, dome_radius=rounded((size**2 / 4 + drop**2) / (2 * drop), 6))
    indenter = _turned(dice, unit)
    depth = rounded(min(thickness * dice.scaled(0.02, 0.4), 0.8 * indenter.sharpest * 4))
    friction = Friction(dice.one_of([0.2, 0.5, 1.0])) if not timed and dice.chance(0.5) else None
    effects = Effects(friction=friction, inertia=Inertia() if timed else None)
    dice.words += effects.key
    depths = [rounded(depth * part) for part in ((0.5, 1.0) if dice.chance(0.5) else (1.0,))]
    speed = dice.scaled(0.3, 3.0) if timed else 10e-3
    return Scene(indenter, press(depths, speed=speed), body, effects)


def _turned(dice: Dice, unit: float) -> Indenter:
    """Return an indenter with an axis, of about `unit` [m], or one of the paper's by size."""
    kind = dice.kind({"sphere": 3, "punch": 2, "cone": 2, "rounded cone": 2, "tube": 1, "torus": 1})
    radius = rounded(unit * dice.even(1.0, 3.0))
    if kind == "sphere":
        return shapes.sphere(rounded(unit * dice.scaled(1.0, 8.0)))
    if kind == "punch":
        return shapes.flat_punch(radius, rounded(radius * dice.even(0.1, 0.4)))
    if kind == "cone":
        return shapes.cone(math.atan(0.35), 0.5 * unit, 0.2 * unit)
    if kind == "rounded cone":
        return shapes.rounded_cone(
            math.radians(dice.even(20.0, 70.0)), rounded(unit * dice.even(0.3, 1.0))
        )
    if kind == "tube":
        return shapes.tube(radius, rounded(0.6 * radius), rounded(0.15 * radius))
    return shapes.torus(radius, rounded(radius * dice.even(0.3, 0.6)))
