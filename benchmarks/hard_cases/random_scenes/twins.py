"""Twins of a scene: mirrored, larger, stiffer, or with other steps; their forces must agree."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from benchmarks.hard_cases.laws import Array, at_most
from benchmarks.hard_cases.random_scenes.referee import Named, Reading
from sim.errors import SceneError
from sim.indenters import Part
from sim.result import Result
from sim.scene import Effects, Gravity, Motion, Point, Scene

# Allowed difference of forces over the largest, or the errors that both results state, if larger:
# symmetry error of default meshes; with friction, where a point that slips early or late affects
# others.
AGREE, AGREE_RUBBING = 0.02, 0.05
LARGER = 10.0


@dataclass(frozen=True, slots=True)
class Twin:
    """Another scene, with the forces that the first one predicts for it."""

    scene: Scene
    forces: Callable[[Array], Array]
    """Maps forces (F, 3) [N] of the first scene to those of the twin; NaN where unknown."""


def agrees(result: Result, name: str, twin: Twin, other: Result) -> Named:
    """Return the law that both scenes have the same forces, within the errors that they state."""
    one, two = Reading(result), Reading(other)
    expected = twin.forces(result.force)
    ratio = two.nothing / one.nothing
    scale = one.largest * ratio
    gap = np.linalg.norm(other.force - expected, axis=1) / scale
    stated = two.stated + one.stated[-len(gap) :] * ratio
    limit = np.maximum(AGREE if one.smooth else AGREE_RUBBING, stated / scale)
    worst = int(np.argmax(np.where(np.isnan(expected).any(axis=1), -np.inf, gap - limit)))
    law = at_most(f"{name}: |difference| / largest", gap[worst], float(limit[worst]))
    return f"twin-{name}", law


def symmetric(result: Result) -> list[Named]:
    """Return the laws of a scene that equals its mirror image: symmetric forces."""
    twins = [(name, twin_of(result.scene, name)) for name in MIRRORS]
    return [
        ("symmetric", agrees(result, name, twin, result)[1])
        for name, twin in twins
        if twin is not None and twin.scene == result.scene
    ]


def twin_of(scene: Scene, name: str) -> Twin | None:
    """Return the twin of that name, or None if the scene has no such twin."""
    try:
        return KINDS[name](scene)
    except SceneError:  # beyond a limit
        return None


# Places at which an indenter is compared with its mirror image, over its depth or size.
PLACES = np.random.default_rng(0).uniform(-1.0, 1.0, (300, 3)) + np.array([0.0, 0.0, 1.0])


def _mirrored(scene: Scene, turn: Array) -> Twin | None:
    """Return the scene in a vertical mirror; None if the indenter looks different there."""

    def turned(vector: Point) -> Point:
        x, y, z = (float(value) for value in turn @ vector)
        return x, y, z

    indenter, body, effects = scene.indenter, scene.body, scene.effects
    x, y, _ = turned((*indenter.tilt, 0.0))
    # An angle changes sign in a mirror, because its axis is a pseudovector.
    other = replace(indenter, tilt=(-x, -y))
    places = PLACES * 2 * body.thickness
    if np.abs(indenter.distance(places)[0] - other.distance(places @ turn.T)[0]).max() > 1e-9:
        return None
    size_x, size_y, _ = map(abs, turned((body.size_x, body.size_y, 0.0)))
    body = replace(body, size_x=size_x, size_y=size_y)
    if effects.gravity is not None:
        effects = replace(effects, gravity=Gravity(turned(effects.gravity.acceleration)))
    motion = replace(scene.motion, tip=tuple(turned(tip) for tip in scene.motion.tip))
    return Twin(Scene(other, motion, body, effects), lambda force: force @ turn.T)


def _larger(scene: Scene) -> Twin | None:
    """Return a twin ten times as large and stiff: weight over stiffness is kept, mass slows it.

    If that is beyond the limits of a body, it is a tenth as large and stiff.
    """
    body, effects = scene.body, scene.effects
    if scene.indenter.solid is not None or scene.indenter.name == "plane":
        return None
    longest = max(body.size_x, body.size_y, body.thickness)
    fits = longest * LARGER <= 1.0 and body.modulus * LARGER <= 1e9
    factor = LARGER if fits else 1.0 / LARGER
    lengths = ("size_x", "size_y", "thickness", "modulus", "dome_radius")
    values = {name: getattr(body, name) for name in lengths}
    scaled = {name: value and value * factor for name, value in values.items()}
    slower = math.sqrt(factor) if effects.inertia is not None else 1.0
    tips = tuple((x * factor, y * factor, z * factor) for x, y, z in scene.motion.tip)
    motion = Motion(tips, tuple(time * slower for time in scene.motion.time))
    if effects.viscosity is not None:
        times = tuple(time * slower for time in effects.viscosity.times)
        effects = replace(effects, viscosity=replace(effects.viscosity, times=times))
    indenter = replace(
        scene.indenter,
        parts=tuple(_scaled(part, factor) for part in scene.indenter.parts),
        edge_radius=scene.indenter.edge_radius * factor,
        narrowest=scene.indenter.narrowest * factor,
    )
    twin = Scene(indenter, motion, replace(body, **scaled), effects)
    return Twin(twin, lambda force: force * factor**3)


def _scaled(part: Part, factor: float) -> Part:
    """Return the part with its lengths scaled, but not directions, and how an arc turns."""
    straight = (1.0, 1.0, factor, factor)
    factors = {"circle": (factor,) * 3, "path": (factor, factor, 1.0) * (len(part.values) // 3)}
    pairs = zip(part.values, factors.get(part.figure, straight), strict=False)
    axis = part.axis[0] * factor, part.axis[1] * factor
    return replace(part, values=tuple(value * by for value, by in pairs), axis=axis)


def _at_once(scene: Scene) -> Twin | None:
    """Return the last frame alone, reached directly; elastic and without friction."""
    x, y, z = scene.motion.tip[-1]
    if scene.effects != Effects() or len(scene.motion) < 3 or z >= 0:
        return None
    way = Motion(((x, y, 0.0), (x, y, z)), (0.0, 1.0))
    twin = Scene(scene.indenter, way, scene.body, Effects())
    return Twin(twin, lambda force: np.stack([force[-1] * np.nan, force[-1]]))


MIRRORS = {
    "mirror-x": np.diag([-1.0, 1.0, 1.0]),
    "mirror-y": np.diag([1.0, -1.0, 1.0]),
    "swap-xy": np.eye(3)[[1, 0, 2]],
}
# Constructor of the twin of each name.
KINDS: dict[str, Callable[[Scene], Twin | None]] = {
    **{name: partial(_mirrored, turn=turn) for name, turn in MIRRORS.items()},
    "ten-times": _larger,
    "at-once": _at_once,
}
