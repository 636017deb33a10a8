"""Randomly drawn scenes: scene i of a seed is reproducible, independently of the others."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.hard_cases.random_scenes.dice import Dice, rounded
from benchmarks.hard_cases.random_scenes.shapes import blade, draw_shape
from sim.errors import SceneError
from sim.fem import Fem, Grading
from sim.fem.mesh import meshes_of
from sim.indenters import Indenter, shapes
from sim.scene import Body, Effects, Friction, Gravity, Inertia, Motion, Scene, Viscosity, through

# Default folder of STL files and counter-examples.
FOLDER = Path("runs/hard-cases")
# Frequencies in percent: typical uses, inputs known to break simulators, and mistakes or values
# beyond every limit.
FAMILIES: dict[str, float] = {"sensible": 70, "trap": 20, "absurd": 10}
# Maximum number of elements of a scene (the paper's gel under a sphere has 6144), to which gels are
# reduced in size. Takes seconds on one core.
ELEMENTS_MAX = 6200
# Longest tip travel with friction, in thicknesses; its steps are a fortieth of the thickness.
TRAVEL_MAX = 1.0
# Frequency of round gels, and their separate random stream, which leaves other draws unchanged.
ROUND, ROUND_STREAM = 1 / 6, 2_000_000
MM = 1e-3
Point = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Drawn:
    """One scene, or its rejection before it was created."""

    seed: int
    index: int
    what: str
    """Description: family, indenter, motion and effects."""
    scene: Scene | None = None
    refusal: Exception | None = None
    """Exception raised instead of a scene."""

    @property
    def name(self) -> str:
        """Seed and number, in the format of `--seed` and `--scene`."""
        return f"{self.seed}/{self.index}"


def drawn(seed: int, index: int, folder: Path = FOLDER) -> Drawn:
    """Return scene `index` of `seed`, writing required STL files to `folder`."""
    dice = Dice(seed, index)
    family = dice.weighted(FAMILIES)
    words = [family]
    make = {"sensible": _sensible, "trap": _trap, "absurd": _absurd}[family]
    try:
        scene = make(dice, folder, words)
        if family == "sensible":
            scene = _sometimes_round(Dice(seed, ROUND_STREAM + index), scene, words)
        scene = within_budget(scene)
    except Exception as error:
        return Drawn(seed, index, ", ".join(words), refusal=error)
    return Drawn(seed, index, ", ".join(words), scene)


def within_budget(scene: Scene) -> Scene:
    """Reduce the gel until the scene has at most `ELEMENTS_MAX` elements of a sixth of it."""
    for _ in range(16):
        try:
            (mesh,) = meshes_of([scene], Fem(grading=Grading()))
        except SceneError:
            return scene  # the solver will raise the same error
        if len(mesh.elements) <= ELEMENTS_MAX:
            return scene
        body = scene.body
        longer = max(body.size_x, body.size_y)
        sizes: dict[str, Any] = {
            name: rounded(0.85 * size) if size > 0.7 * longer else size
            for name, size in (("size_x", body.size_x), ("size_y", body.size_y))
        }
        scene = replace(scene, body=replace(body, **sizes))
    return scene


# Typical uses.


def _sensible(dice: Dice, folder: Path, words: list[str]) -> Scene:
    body = _body(dice)
    kind, indenter = draw_shape(dice, body.thickness / 4, folder)
    words.append(kind)
    place = _place(dice, body, words)
    effects = _effects(dice, body, words)
    depth = body.thickness * dice.scaled(0.01, 0.4)
    return Scene(indenter, _motion(dice, body, depth, place, effects, words), body, effects)


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
    lowest = -0.89 * body.thickness
    rise = body.height(*tip[0][:2]) - scene.body.height(*tip[0][:2])
    lowered = tuple((x, y, max(rounded(z + rise, 6), lowest)) for x, y, z in tip)
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


def _place(dice: Dice, body: Body, words: list[str]) -> tuple[float, float]:
    """Return the place of the press: centre, anywhere, at a rim, over it, or at a corner."""
    where = dice.weighted({"centre": 5, "anywhere": 4, "at the rim": 2, "at the corner": 1})
    half = body.size_x / 2, body.size_y / 2
    if where == "centre":
        return 0.0, 0.0
    words.append(where)
    if where == "anywhere":
        return rounded(half[0] * dice.even(-0.6, 0.6)), rounded(half[1] * dice.even(-0.6, 0.6))
    x = rounded(dice.signed(half[0] * dice.even(0.8, 1.15)))
    y = rounded(half[1] * dice.even(-0.5, 0.5))
    if where == "at the corner":
        y = rounded(dice.signed(half[1] * dice.even(0.8, 1.1)))
    return (x, y) if dice.chance(0.5) else (rounded(y * half[0] / half[1]), x * half[1] / half[0])


def _effects(dice: Dice, body: Body, words: list[str]) -> Effects:
    friction = viscosity = inertia = gravity = None
    if dice.chance(0.35):
        friction = Friction(dice.one_of([0.0, 0.1, 0.3, 0.8, rounded(dice.even(0.0, 2.0))]))
    if dice.chance(0.12):
        branches = dice.whole(1, 3)
        viscosity = Viscosity(
            tuple(dice.scaled(0.1, 3.0) for _ in range(branches)),
            tuple(dice.scaled(1e-2, 10.0) for _ in range(branches)),
        )
    if dice.chance(0.06):
        inertia = Inertia(dice.one_of([1.0, 1.0, 100.0]))
    if dice.chance(0.1):
        gravity = Gravity(dice.one_of([(0.0, 0.0, -9.81), (0.0, 0.0, 9.81), (9.81, 0.0, 0.0)]))
    effects = Effects(friction, viscosity, inertia, gravity)
    words += [f"friction {friction.coefficient:g}"] if friction else []
    words += [name for name in effects.key if name != "friction"]
    return effects


Way = Callable[[Dice, float, float], list[Point]]


def _motion(
    dice: Dice,
    body: Body,
    depth: float,
    place: tuple[float, float],
    effects: Effects,
    words: list[str],
) -> Motion:
    """Return a press, a cycle, the same depth twice, a shear and its return, or a slide."""
    kind = dice.weighted({"press": 5, "cycle": 2, "twice": 1, "shear": 3, "slide": 1})
    words.append(kind)
    depth = rounded(min(depth, 0.89 * body.thickness))
    ground = body.height(*place) if body.dome_radius is not None and _over(body, place) else 0.0
    if effects.friction is not None:
        depth = min(depth, rounded(TRAVEL_MAX / 3 * body.thickness))
    x, y = place
    away = rounded(0.1 * body.thickness)
    deep = [rounded(depth * fraction) for fraction in (0.5, 1.0)]
    if kind == "press":
        fractions = [(step + 1) / count for count in (dice.whole(1, 4),) for step in range(count)]
        levels = [-rounded(depth * fraction) for fraction in fractions]
        points = [(x, y, 0.0), *((x, y, level) for level in levels)]
    elif kind == "cycle":
        down = [(x, y, away), (x, y, 0.0), *((x, y, -level) for level in deep)]
        points = [*down, *reversed(down[:-1])]
    elif kind == "twice":
        points = [(x, y, 0.0), (x, y, -depth), (x, y, -deep[0]), (x, y, -depth)]
    else:
        aside = rounded(depth * dice.scaled(0.1, 2.0))
        if effects.friction is not None:
            aside = min(aside, rounded(TRAVEL_MAX / 3 * body.thickness))
        angle = dice.one_of([0.0, math.pi / 2, dice.even(0.0, math.tau)])
        low = (x, y, -depth)
        over = (rounded(x + aside * math.cos(angle)), rounded(y + aside * math.sin(angle)), -depth)
        points = [(x, y, 0.0), low, over]
        if kind == "shear":
            points += [low, (x, y, 0.0)]
        points.append((points[-1][0], points[-1][1], away))
    lowered = [(px, py, max(pz + ground, -0.89 * body.thickness)) for px, py, pz in points]
    speed = dice.one_of([10e-3, 10e-3, dice.scaled(1e-4, 1.0)])
    return through(lowered, speed=speed)


def _over(body: Body, place: tuple[float, float]) -> bool:
    return abs(place[0]) <= body.size_x / 2 and abs(place[1]) <= body.size_y / 2


# Inputs known to break simulators.


def _trap(dice: Dice, folder: Path, words: list[str]) -> Scene:
    kind = dice.weighted(
        {"blade": 3, "corner": 2, "first touch": 2, "deep": 3, "material": 2, "far aside": 1.5,
         "heavy": 1, "fast": 1, "friction": 1.5, "size": 1.5}
    )  # fmt: skip
    words.append(kind)
    body = Body(size_x=16 * MM, size_y=16 * MM, poisson=dice.one_of([0.45, 0.45, 0.49, 0.3]))
    ball = shapes.sphere(rounded(MM * dice.even(2.0, 6.0)))
    if kind == "blade":
        return _down(blade(dice, MM), body, MM * dice.even(1.0, 3.0), steps=dice.whole(1, 3))
    if kind == "corner":
        body = replace(body, size_x=10 * MM, size_y=10 * MM)
        at = (dice.even(0.8, 1.05) * 5 * MM, dice.even(0.8, 1.05) * 5 * MM)
        indenter = ball if dice.chance(0.7) else shapes.named("prism")
        return _down(indenter, body, MM * dice.even(1.5, 3.5), at=at, steps=dice.whole(1, 3))
    if kind == "first touch":
        shape, indenter = draw_shape(dice, MM, folder)
        words.append(shape)
        at = (rounded(MM * dice.even(-3.0, 3.0)), rounded(MM * dice.even(-3.0, 3.0)))
        return _down(indenter, body, dice.scaled(1e-6, 20e-6), at=at, steps=dice.whole(1, 3))
    if kind == "deep":
        shape, indenter = draw_shape(dice, MM, folder)
        words.append(shape)
        return _down(indenter, body, MM * dice.even(2.0, 3.59), steps=dice.whole(1, 4))
    if kind == "material":
        hard = replace(
            body,
            modulus=dice.scaled(1e2, 1e9),
            poisson=dice.one_of([0.0, 0.4, 0.49, 0.499, 0.4999, 0.49995]),
        )
        shape, indenter = draw_shape(dice, MM, folder)
        words.append(shape)
        return _down(indenter, hard, MM * dice.even(0.2, 1.5), steps=dice.whole(1, 3))
    if kind == "far aside":
        body = replace(body, size_x=12 * MM, size_y=10 * MM)
        depth, aside = MM * dice.even(0.5, 1.2), rounded(MM * dice.even(1.0, 3.0))
        friction = Friction(dice.one_of([0.5, 1.0, 2.0]))
        # Lifted during slip, before contact ends.
        lifts = [(aside, 0.0, -rounded(fraction * depth)) for fraction in (1.0, 0.6, 0.3)]
        points = [(0.0, 0.0, 0.0), (0.0, 0.0, -depth), *lifts, (aside, 0.0, MM)]
        return Scene(ball, through(points, speed=10e-3), body, Effects(friction=friction))
    if kind == "heavy":
        pull = dice.signed(dice.scaled(30.0, 1000.0))
        gravity = Gravity((0.0, 0.0, pull) if dice.chance(0.7) else (pull, 0.0, 0.0))
        soft = replace(body, modulus=dice.scaled(1e3, 1e5))
        return replace(_down(ball, soft, MM), effects=Effects(gravity=gravity))
    if kind == "fast":
        scene = _down(ball, body, MM * dice.even(0.3, 1.5), speed=dice.scaled(0.3, 30.0))
        return replace(scene, effects=Effects(inertia=Inertia()))
    if kind == "friction":
        shape, indenter = draw_shape(dice, MM, folder)
        words.append(shape)
        scene = _down(indenter, body, MM * dice.even(0.3, 1.5), up=True)
        return replace(scene, effects=Effects(friction=Friction(dice.one_of([0.02, 0.9, 2.0]))))
    factor = dice.one_of([0.03, 0.1, 10.0, 30.0])
    scale = {name: getattr(body, name) * factor for name in ("size_x", "size_y", "thickness")}
    indenter = shapes.sphere(4 * MM * factor)
    return _down(indenter, replace(body, **scale), MM * factor * dice.even(0.2, 2.0))


def _down(
    indenter: Indenter,
    body: Body,
    depth: float,
    *,
    at: tuple[float, float] = (0.0, 0.0),
    steps: int = 1,
    speed: float = 10e-3,
    up: bool = False,
) -> Scene:
    """Return a scene that touches, presses to `depth` [m] in equal steps, and optionally lifts."""
    x, y = rounded(at[0]), rounded(at[1])
    points = [(x, y, -rounded(depth * step / steps)) for step in range(steps + 1)]
    if up:
        points += [(x, y, -rounded(depth / 2)), (x, y, rounded(0.1 * body.thickness))]
    return Scene(indenter, through(points, speed=speed), body)


# Mistakes, and values beyond every limit.


def _absurd(dice: Dice, _folder: Path, words: list[str]) -> Scene:
    kind = dice.one_of(sorted(_ABSURD))
    words.append(kind)
    return _ABSURD[kind](dice)


BALL = shapes.sphere(4 * MM)


def _still(dice: Dice) -> Scene:
    depth = MM * dice.even(0.1, 1.0)
    return Scene(BALL, through([(0.0, 0.0, 0.0), (0, 0, -depth), (0, 0, -depth)], speed=1e-2))


def _held(dice: Dice) -> Scene:
    """Return a scene with one waypoint, or with the same one at later times."""
    tip = (0.0, 0.0, -MM * dice.even(0.0, 1.5))
    count = dice.whole(1, 3)
    return Scene(BALL, Motion((tip,) * count, tuple(float(step) for step in range(count))))


def _from_beside(dice: Dice) -> Scene:
    """Return a motion from outside the gel into its side, below the surface."""
    depth = MM * dice.even(0.5, 3.0)
    points = [(x * MM, 0.0, -depth) for x in (15.0, 12.0, 9.0)]
    return Scene(BALL, through(points, speed=10e-3), Body(size_x=16 * MM, size_y=16 * MM))


def _off_the_gel(dice: Dice) -> Scene:
    return _down(BALL, Body(), MM * dice.even(0.5, 3.5), at=(dice.even(15.0, 500.0) * MM, 0.0))


def _never_there(dice: Dice) -> Scene:
    height = MM * dice.even(0.1, 20.0)
    return Scene(BALL, through([(0.0, 0.0, 2 * height), (0.0, 0.0, height)], speed=10e-3))


def _metre(dice: Dice) -> Scene:
    size = dice.one_of([0.5, 1.0])
    body = Body(size, size, 0.25 * size)
    return _down(shapes.sphere(0.2 * size), body, 0.05 * size * dice.even(0.1, 1.0))


def _millimetres(dice: Dice) -> Scene:
    return _down(BALL, Body(), dice.even(0.5, 2.0))


def _large_body(_dice: Dice) -> Scene:
    return _down(BALL, Body(20.0, 20.0, 4.0), MM)


def _too_soft(dice: Dice) -> Scene:
    return _down(BALL, Body(modulus=dice.one_of([0.0, -1e5, 1.0, math.nan, math.inf])), MM)


def _incompressible(dice: Dice) -> Scene:
    return _down(BALL, Body(poisson=dice.one_of([0.5, 0.49999, -0.2, math.nan])), MM)


def _speck(dice: Dice) -> Scene:
    """Return a body of minimum size under a large ball."""
    return _down(BALL, Body(1e-4, 1e-4, 1e-4), 1e-5 * dice.even(0.1, 8.0))


def _column(dice: Dice) -> Scene:
    """Return a body many times taller than wide."""
    width = MM * dice.even(1.0, 4.0)
    return _down(BALL, Body(width, width, 20 * MM), MM * dice.even(0.2, 3.0))


def _sheet(dice: Dice) -> Scene:
    return _down(BALL, Body(4 * MM, 4 * MM, 0.5 * MM), MM * dice.even(0.02, 0.4))


def _pin(dice: Dice) -> Scene:
    """Return a needle smaller than any element."""
    return _down(shapes.sphere(MM * dice.scaled(0.01, 0.3)), Body(), MM * dice.even(0.2, 1.5))


def _sticky(dice: Dice) -> Scene:
    friction = Friction(dice.one_of([5.0, 10.0, 11.0, -0.1]))
    return replace(_down(BALL, Body(), MM, up=True), effects=Effects(friction=friction))


def _steep_dome(dice: Dice) -> Scene:
    return _down(BALL, Body(dome_radius=MM * dice.even(5.0, 40.0)), MM)


def _frozen(dice: Dice) -> Scene:
    """Return branches a hundred times stiffer than the equilibrium modulus."""
    viscosity = Viscosity((100.0,), (dice.scaled(1e-6, 1e6),))
    return replace(_down(BALL, Body(), 0.5 * MM), effects=Effects(viscosity=viscosity))


_ABSURD: dict[str, Callable[[Dice], Scene]] = {
    make.__name__.strip("_").replace("_", " "): make
    for make in (
        _still, _held, _from_beside, _off_the_gel, _never_there, _metre, _millimetres, _large_body,
        _too_soft, _incompressible, _speck, _column, _sheet, _pin, _sticky, _steep_dome, _frozen,
    )
}  # fmt: skip
