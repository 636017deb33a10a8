"""Random scenes: those the table is made from, and wider ones that it is checked with."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sim.effects import Effects, Friction, Viscosity
from sim.indenters import (
    NAMES,
    Indenter,
    bar,
    box,
    flat_punch,
    named,
    rounded_cone,
    sphere,
    torus,
    tube,
)
from sim.scene import Body, Motion, Scene, ramp_hold, through

MM = 1e-3
SPEED = 10 * MM
BATCH = 10
"""Scenes that share a body and a set of effects, and so a launch."""
ROOM = 0.46
"""Share of the body's width that an indenter's half width may take, off centre or not."""
TRIES = 200
"""Draws after which a shape that never fits is an error."""

Random = np.random.Generator
Range = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Ranges:
    """What scenes are drawn from."""

    thickness: Range
    """[m]."""
    width: Range
    """Of the body, in thicknesses."""
    poisson: Range
    modulus: Range
    """[Pa]."""
    depth: Range
    """Deepest, in thicknesses."""
    friction: Range
    shear: Range
    """Way aside over depth."""
    edge: Range
    """Edge radius [m], as far as there is room."""
    ratio: Range
    """Stiffness of the viscous branch."""
    extra: bool
    """Whether boxes and bars are drawn as well."""


TRAINING = Ranges(
    thickness=(2 * MM, 8 * MM),
    width=(2.2, 5.5),
    poisson=(0.27, 0.492),
    modulus=(1e4, 1e6),
    depth=(0.06, 0.42),
    friction=(0.05, 1.1),
    shear=(0.15, 1.3),
    edge=(0.3 * MM, 1.0 * MM),
    ratio=(0.1, 1.0),
    extra=False,
)
HELD_OUT = Ranges(
    thickness=(1.5 * MM, 10 * MM),
    width=(2.0, 6.0),
    poisson=(0.25, 0.494),
    modulus=(3e3, 3e6),
    depth=(0.05, 0.46),
    friction=(0.03, 1.2),
    shear=(0.1, 1.4),
    edge=(0.25 * MM, 1.2 * MM),
    ratio=(0.05, 1.2),
    extra=True,
)
"""Wider in everything, with shapes that are not in training; what lies outside is refused."""

EFFECTS = ("none", "friction", "viscosity", "none", "friction", "both")
"""Effects of batches in turn; `both` is friction and viscosity."""
SHEARED = {"none": 0.15, "friction": 0.75, "viscosity": 0.15, "both": 0.5}
"""Share of scenes that are sheared, the others are pressed only."""
RELAXATION = (0.05, 1.0)
"""Time of the viscous branch [s]."""


def batch(seed: int, index: int, ranges: Ranges) -> list[Scene]:
    """Batch `index` of a seed: scenes with one body shape and one set of effects."""
    random = np.random.default_rng([seed, index])
    thickness = _log(random, ranges.thickness)
    width = thickness * random.uniform(*ranges.width)
    length = width * random.uniform(0.85, 1.0)
    kind = EFFECTS[index % len(EFFECTS)]
    scenes: list[Scene] = []
    while len(scenes) < BATCH:
        body = Body(
            size_x=width,
            size_y=length,
            thickness=thickness,
            modulus=_log(random, ranges.modulus),
            poisson=random.uniform(*ranges.poisson),
        )
        scenes.append(_scene(random, ranges, body, kind))
    return scenes


def _scene(random: Random, ranges: Ranges, body: Body, kind: str) -> Scene:
    indenter, at = _placed(random, ranges, body)
    depth = body.thickness * random.uniform(*ranges.depth)
    friction, viscosity = None, None
    if kind in ("friction", "both"):
        friction = Friction(random.uniform(*ranges.friction))
    if kind in ("viscosity", "both"):
        viscosity = Viscosity((random.uniform(*ranges.ratio),), (_log(random, RELAXATION),))
    if random.random() < SHEARED[kind]:
        motion = _sheared(random, ranges, depth, at)
    elif viscosity is not None:
        motion = ramp_hold(depth, ramp=depth / SPEED, hold=0.5, steps=2, at=at)
    else:
        motion = _press(random, depth, at)
    return Scene(indenter, motion, body=body, effects=Effects(friction, viscosity))


def _press(random: Random, depth: float, at: tuple[float, float]) -> Motion:
    half = depth * random.uniform(0.3, 0.7)
    return through([(*at, 0.0), (*at, -half), (*at, -depth)], speed=SPEED)


def _sheared(random: Random, ranges: Ranges, depth: float, at: tuple[float, float]) -> Motion:
    """Down and aside, and half of the time back again."""
    angle, way = random.uniform(0, math.tau), depth * random.uniform(*ranges.shear)
    aside = at[0] + way * math.cos(angle), at[1] + way * math.sin(angle), -depth
    points = [(*at, 0.0), (*at, -depth), aside]
    if random.random() < 0.5:
        points.append((*at, -depth))
    return through(points, speed=SPEED)


def _placed(random: Random, ranges: Ranges, body: Body) -> tuple[Indenter, tuple[float, float]]:
    """A shape that fits the body, and where it is pressed in [m]."""
    for _ in range(TRIES):
        indenter = _shape(random, ranges, body.thickness)
        reach_x, reach_y = (max(abs(low), abs(high)) for low, high in indenter.bounds[:2])
        free_x, free_y = ROOM * body.size_x - reach_x, ROOM * body.size_y - reach_y
        if min(free_x, free_y) > 0:
            return indenter, (random.uniform(-free_x, free_x), random.uniform(-free_y, free_y))
    raise RuntimeError(f"no shape fits a body of {body.size_x} x {body.size_y} m")


def _shape(random: Random, ranges: Ranges, thickness: float) -> Indenter:
    def length(low: float, high: float) -> float:
        return thickness * _log(random, (low, high))

    def edge(room: float) -> float:
        return min(_log(random, ranges.edge), 0.98 * room)

    def drawn_punch() -> Indenter:
        radius = length(0.25, 1.0)
        return flat_punch(radius, edge(radius))

    def drawn_cone() -> Indenter:
        return rounded_cone(math.radians(random.uniform(30, 60)), edge(thickness))

    def drawn_tube() -> Indenter:
        outer = length(0.5, 1.1)
        inner = outer * random.uniform(0.3, 0.65)
        return tube(outer, inner, edge((outer - inner) / 2))

    def drawn_torus() -> Indenter:
        ring = length(0.4, 0.9)
        return torus(ring, ring * random.uniform(0.3, 0.7))

    def drawn_name() -> Indenter:
        name = str(random.choice(NAMES))
        own = named(name)
        return named(name, edge(own.edge_radius_max)) if own.edge_radius else own

    def drawn_box() -> Indenter:
        one, other = length(0.4, 1.6), length(0.4, 1.6)
        return box(one, other, edge(min(one, other) / 2))

    def drawn_bar() -> Indenter:
        radius = length(0.3, 1.0)
        return bar(radius, length(0.8, 2.0), edge(radius / 2))

    def drawn_sphere() -> Indenter:
        return sphere(length(0.35, 1.2))

    shapes: list[Callable[[], Indenter]] = [
        drawn_sphere,
        drawn_sphere,
        drawn_punch,
        drawn_cone,
        drawn_tube,
        drawn_torus,
        drawn_torus,
        drawn_name,
        drawn_name,
    ]
    if ranges.extra:
        shapes += [drawn_box, drawn_bar]
    return shapes[int(random.integers(len(shapes)))]()


def _log(random: Random, limits: Range) -> float:
    return float(np.exp(random.uniform(math.log(limits[0]), math.log(limits[1]))))
