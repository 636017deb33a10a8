"""Randomly drawn scenes: scene i of a seed is reproducible, independently of the others."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.hard_cases.random_scenes.dice import Dice, rounded
from benchmarks.hard_cases.random_scenes.shapes import MM, blade, draw_shape
from sim.errors import SceneError
from sim.fem import Fem, Grading
from sim.fem.mesh import meshes_of
from sim.indenters import Indenter, shapes
from sim.scene import Body, Effects, Friction, Gravity, Inertia, Motion, Scene, Viscosity, through

# Default folder of STL files and counter-examples.
FOLDER = Path("build/hard-cases")
# Frequencies in percent: typical uses, inputs known to break simulators, and mistakes or values
# beyond every limit.
FAMILIES: dict[str, float] = {"sensible": 70, "trap": 20, "absurd": 10}
# Maximum number of elements of a scene (the paper's gel under a sphere has 6144), to which gels are
# reduced in size. Takes seconds on one core.
ELEMENTS_MAX = 6200
# Frequency of round gels, and their separate random stream, which leaves other draws unchanged.
ROUND, ROUND_STREAM = 1 / 6, 2_000_000
NO_EFFECTS = Effects()


@dataclass(frozen=True, slots=True)
class Drawn:
    """One scene, or its rejection before it was created."""

    name: str
    """Seed and number, in the format of `--seed` and `--first`."""
    what: str
    """Description: family, indenter, motion and effects."""
    scene: Scene | None = None
    refusal: Exception | None = None
    """Exception raised instead of a scene."""


def drawn(seed: int, index: int, folder: Path = FOLDER) -> Drawn:
    """Return scene `index` of `seed`, writing required STL files to `folder`."""
    dice, scene, refusal = Dice(seed, index), None, None
    try:
        family = dice.kind(FAMILIES)
        if family == "sensible":
            scene = _sensible(dice, folder)
            scene = _sometimes_round(Dice(seed, ROUND_STREAM + index), scene, dice.words)
        elif family == "trap":
            scene = _trap(dice, folder)
        else:
            scene = _ABSURD[dice.kind(dict.fromkeys(sorted(_ABSURD), 1))](dice)
        scene = within_budget(scene)
    except Exception as error:
        scene, refusal = None, error
    return Drawn(f"{seed}/{index}", ", ".join(dice.words), scene, refusal)


def within_budget(scene: Scene) -> Scene:
    """Reduce the gel until the scene has at most `ELEMENTS_MAX` elements of a sixth of it."""
    for _ in range(16):
        try:
            (mesh,) = meshes_of([scene], Fem(grading=Grading()))
        except SceneError:
            break  # the solver will raise the same error
        if len(mesh.elements) <= ELEMENTS_MAX:
            break
        sizes = scene.body.size_x, scene.body.size_y
        size_x, size_y = (
            rounded(0.85 * size) if size > 0.7 * max(sizes) else size for size in sizes
        )
        scene = replace(scene, body=replace(scene.body, size_x=size_x, size_y=size_y))
    return scene


# Typical uses.


def _sensible(dice: Dice, folder: Path) -> Scene:
    body = _body(dice)
    indenter = draw_shape(dice, body.thickness / 4, folder)
    place = _place(dice, body)
    effects = _effects(dice)
    depth = body.thickness * dice.scaled(0.01, 0.4)
    # The steps of friction are a fortieth of the thickness, so its path is limited to that.
    most = math.inf if effects.friction is None else rounded(body.thickness / 3)
    return Scene(indenter, _motion(dice, body, depth, most, place), body, effects)


def _sometimes_round(dice: Dice, scene: Scene, words: list[str]) -> Scene:
    """Make one in six gels an ellipse within its sides, half of them domed with a thin rim."""
    if not dice.chance(ROUND):
        return scene
    words.append("round")
    body = replace(scene.body, footprint="ellipse")
    if dice.chance(0.5):
        half, drop = max(body.size_x, body.size_y) / 2, dice.even(0.1, 0.94) * body.thickness
        radius = rounded((half**2 + drop**2) / (2 * drop), 6)
        if radius > half:
            words.append("dome")
            body = replace(body, dome_radius=radius)
    tip = scene.motion.tip
    rise = body.height(*tip[0][:2]) - scene.body.height(*tip[0][:2])
    lowered = tuple((x, y, max(rounded(z + rise, 6), -0.89 * body.thickness)) for x, y, z in tip)
    return replace(scene, body=body, motion=replace(scene.motion, tip=lowered))


def _body(dice: Dice) -> Body:
    """Return a gel 0.5 to 20 mm thick, flat or domed."""
    thickness = dice.one_of([4.0 * MM, 4.0 * MM, rounded(MM * dice.scaled(0.5, 20.0))])
    size_x, size_y = (rounded(thickness * dice.scaled(1.5, 6.0)) for _ in range(2))
    if dice.chance(0.4):
        size_y = size_x
    dome = None
    if dice.chance(0.15):
        drop, corner = 0.45 * thickness, math.hypot(size_x, size_y) / 2
        least = max((corner**2 + drop**2) / (2 * drop), corner)
        dome = rounded(least * dice.scaled(1.02, 6.0))
    return Body(
        size_x, size_y, thickness,
        modulus=dice.scaled(1e4, 3e6),
        poisson=dice.weighted({0.45: 4, 0.49: 2, 0.3: 1, 0.0: 0.5, 0.499: 1, 0.4999: 0.3}),
        dome_radius=dome,
    )  # fmt: skip


def _place(dice: Dice, body: Body) -> tuple[float, float]:
    """Return the place of the press: centre, anywhere, at a rim, over it, or at a corner."""
    where = dice.weighted({"centre": 5, "anywhere": 4, "at the rim": 2, "at the corner": 1})
    half_x, half_y = body.size_x / 2, body.size_y / 2
    if where == "centre":
        return 0.0, 0.0
    dice.words.append(where)
    if where == "anywhere":
        return rounded(half_x * dice.even(-0.6, 0.6)), rounded(half_y * dice.even(-0.6, 0.6))
    x = rounded(half_x * dice.even(0.8, 1.15) * dice.one_of([1, -1]))
    y = rounded(half_y * dice.even(-0.5, 0.5))
    if where == "at the corner":
        y = rounded(half_y * dice.even(0.8, 1.1) * dice.one_of([1, -1]))
    return (x, y) if dice.chance(0.5) else (rounded(y * half_x / half_y), x * half_y / half_x)


def _effects(dice: Dice) -> Effects:
    friction = viscosity = inertia = gravity = None
    if dice.chance(0.35):
        friction = Friction(dice.one_of([0.0, 0.1, 0.3, 0.8, rounded(dice.even(0.0, 2.0))]))
        dice.words.append(f"friction {friction.coefficient:g}")
    if dice.chance(0.12):
        branches = range(dice.whole(1, 3))
        ratios = tuple(dice.scaled(0.1, 3.0) for _ in branches)
        viscosity = Viscosity(ratios, tuple(dice.scaled(1e-2, 10.0) for _ in branches))
    if dice.chance(0.06):
        inertia = Inertia(dice.one_of([1.0, 1.0, 100.0]))
    if dice.chance(0.1):
        gravity = Gravity(dice.one_of([(0.0, 0.0, -9.81), (0.0, 0.0, 9.81), (9.81, 0.0, 0.0)]))
    effects = Effects(friction, viscosity, inertia, gravity)
    dice.words += [name for name in effects.key if name != "friction"]
    return effects


def _motion(
    dice: Dice, body: Body, depth: float, most: float, place: tuple[float, float]
) -> Motion:
    """Return a press, a cycle, the same depth twice, a shear and its return, or a slide.

    Neither depth nor travel is above `most` [m].
    """
    kind = dice.kind({"press": 5, "cycle": 2, "twice": 1, "shear": 3, "slide": 1})
    x, y = place
    depth = min(rounded(depth), most)
    half, away = rounded(depth / 2), rounded(0.1 * body.thickness)
    if kind == "press":
        count = dice.whole(1, 4)
        levels = [0.0, *(-rounded(depth * ((step + 1) / count)) for step in range(count))]
    elif kind == "cycle":
        levels = [away, 0.0, -half, -depth, -half, 0.0, away]
    else:
        levels = [0.0, -depth, -half, -depth]
    points = [(x, y, level) for level in levels]
    if kind in ("shear", "slide"):
        aside = min(rounded(depth * dice.scaled(0.1, 2.0)), most)
        angle = dice.one_of([0.0, math.pi / 2, dice.even(0.0, math.tau)])
        over = rounded(x + aside * math.cos(angle)), rounded(y + aside * math.sin(angle))
        points = [(x, y, 0.0), (x, y, -depth), (*over, -depth)]
        back = [(x, y, -depth), (x, y, 0.0), (x, y, away)]
        points += back if kind == "shear" else [(*over, away)]
    inside = abs(x) <= body.size_x / 2 and abs(y) <= body.size_y / 2
    ground = body.height(x, y) if inside else 0.0
    lowered = [(px, py, max(pz + ground, -0.89 * body.thickness)) for px, py, pz in points]
    return through(lowered, speed=dice.one_of([10e-3, 10e-3, dice.scaled(1e-4, 1.0)]))


# Inputs known to break simulators, and how often each.

TRAPS: dict[str, float] = {
    "blade": 3, "corner": 2, "first touch": 2, "deep": 3, "material": 2, "far aside": 1.5,
    "heavy": 1, "fast": 1, "friction": 1.5, "size": 1.5,
}  # fmt: skip


def _trap(dice: Dice, folder: Path) -> Scene:
    kind = dice.kind(TRAPS)
    body = Body(size_x=16 * MM, size_y=16 * MM, poisson=dice.one_of([0.45, 0.45, 0.49, 0.3]))
    ball = shapes.sphere(rounded(MM * dice.even(2.0, 6.0)))
    if kind == "blade":
        return _down(blade(dice, MM), body, MM * dice.even(1.0, 3.0), steps=dice.whole(1, 3))
    if kind == "corner":
        body = replace(body, size_x=10 * MM, size_y=10 * MM)
        at = (dice.even(0.8, 1.05) * 5 * MM, dice.even(0.8, 1.05) * 5 * MM)
        indenter = ball if dice.chance(0.7) else shapes.named("prism")
        return _down(indenter, body, MM * dice.even(1.5, 3.5), at=at, steps=dice.whole(1, 3))
    if kind == "far aside":
        body = replace(body, size_x=12 * MM, size_y=10 * MM)
        depth, aside = MM * dice.even(0.5, 1.2), rounded(MM * dice.even(1.0, 3.0))
        effects = Effects(friction=Friction(dice.one_of([0.5, 1.0, 2.0])))
        # Lifted during slip, before contact ends.
        lifts = [(aside, 0.0, -rounded(fraction * depth)) for fraction in (1.0, 0.6, 0.3)]
        points = [(0.0, 0.0, 0.0), (0.0, 0.0, -depth), *lifts, (aside, 0.0, MM)]
        return Scene(ball, through(points, speed=10e-3), body, effects)
    if kind == "heavy":
        pull = dice.scaled(30.0, 1000.0) * dice.one_of([1, -1])
        gravity = Gravity((0.0, 0.0, pull) if dice.chance(0.7) else (pull, 0.0, 0.0))
        soft = replace(body, modulus=dice.scaled(1e3, 1e5))
        return _down(ball, soft, MM, effects=Effects(gravity=gravity))
    if kind == "fast":
        depth, speed = MM * dice.even(0.3, 1.5), dice.scaled(0.3, 30.0)
        return _down(ball, body, depth, speed=speed, effects=Effects(inertia=Inertia()))
    if kind == "size":
        unit = MM * dice.one_of([0.03, 0.1, 10.0, 30.0])
        body = replace(body, size_x=16 * unit, size_y=16 * unit, thickness=4 * unit)
        return _down(shapes.sphere(4 * unit), body, unit * dice.even(0.2, 2.0))
    if kind == "material":
        modulus = dice.scaled(1e2, 1e9)
        poisson = dice.one_of([0.0, 0.4, 0.49, 0.499, 0.4999, 0.49995])
        body = replace(body, modulus=modulus, poisson=poisson)
    indenter = draw_shape(dice, MM, folder)
    if kind == "first touch":
        at = (MM * dice.even(-3.0, 3.0), MM * dice.even(-3.0, 3.0))
        return _down(indenter, body, dice.scaled(1e-6, 20e-6), at=at, steps=dice.whole(1, 3))
    if kind == "friction":
        depth, effects = MM * dice.even(0.3, 1.5), Effects(Friction(dice.one_of([0.02, 0.9, 2.0])))
        return _down(indenter, body, depth, effects=effects)
    low, high, most = (2.0, 3.59, 4) if kind == "deep" else (0.2, 1.5, 3)
    return _down(indenter, body, MM * dice.even(low, high), steps=dice.whole(1, most))


def _down(
    indenter: Indenter,
    body: Body,
    depth: float,
    *,
    at: tuple[float, float] = (0.0, 0.0),
    steps: int = 1,
    speed: float = 10e-3,
    effects: Effects = NO_EFFECTS,
) -> Scene:
    """Return a scene that presses to `depth` [m] in equal steps, and lifts if there is friction."""
    x, y = rounded(at[0]), rounded(at[1])
    levels = [-rounded(depth * step / steps) for step in range(steps + 1)]
    if effects.friction is not None:
        levels += [-rounded(depth / 2), rounded(0.1 * body.thickness)]
    motion = through([(x, y, level) for level in levels], speed=speed)
    return Scene(indenter, motion, body, effects)


# Mistakes, and values beyond every limit.


BALL = shapes.sphere(4 * MM)
# Values of a gel that must be refused.
WRONG_VALUES: list[tuple[str, Any]] = [
    ("modulus", 0.0), ("modulus", -1e5), ("modulus", 1.0), ("modulus", math.inf),
    ("poisson", 0.5), ("poisson", 0.49999), ("poisson", -0.2), ("poisson", math.nan),
    ("size_x", 20.0), ("thickness", 4.0), ("dome_radius", 5 * MM), ("dome_radius", 9 * MM),
]  # fmt: skip


def _along_its_side(dice: Dice) -> Scene:
    """Return a motion from outside the gel into its side, below the surface."""
    depth = MM * dice.even(0.5, 3.0)
    way = through([(x * MM, 0.0, -depth) for x in (15.0, 12.0, 9.0)], speed=10e-3)
    return Scene(BALL, way, Body(size_x=16 * MM, size_y=16 * MM))


def _held(dice: Dice) -> Scene:
    """Return a scene with one waypoint, or with the same one at later times."""
    tip = (0.0, 0.0, MM * dice.even(-1.5, 0.5))
    count = dice.whole(1, 3)
    return Scene(BALL, Motion((tip,) * count, tuple(float(step) for step in range(count))))


def _sticky(dice: Dice) -> Scene:
    friction = Friction(dice.one_of([5.0, 10.0, 11.0, -0.1]))
    return _down(BALL, Body(), MM, effects=Effects(friction=friction))


def _frozen(dice: Dice) -> Scene:
    """Return branches a hundred times stiffer than the equilibrium modulus."""
    viscosity = Viscosity((100.0,), (dice.scaled(1e-6, 1e6),))
    return _down(BALL, Body(), 0.5 * MM, effects=Effects(viscosity=viscosity))


_ABSURD: dict[str, Callable[[Dice], Scene]] = {
    "wrong value": lambda dice: _down(BALL, Body(**dict([dice.one_of(WRONG_VALUES)])), MM),
    "along its side": _along_its_side,
    "held": _held,
    "off the gel": lambda dice: _down(BALL, Body(), MM, at=(dice.even(15.0, 500.0) * MM, 0.0)),
    "millimetres": lambda dice: _down(BALL, Body(), dice.even(0.5, 2.0)),
    "speck": lambda dice: _down(BALL, Body(1e-4, 1e-4, 1e-4), MM * dice.even(0.001, 0.08)),
    "column": lambda dice: _down(BALL, Body(2 * MM, 3 * MM, 20 * MM), MM * dice.even(0.2, 3.0)),
    "sheet": lambda dice: _down(BALL, Body(4 * MM, 4 * MM, 0.5 * MM), MM * dice.even(0.02, 0.4)),
    "pin": lambda dice: _down(shapes.sphere(MM * dice.scaled(0.01, 0.3)), Body(), MM),
    "sticky": _sticky,
    "frozen": _frozen,
}
