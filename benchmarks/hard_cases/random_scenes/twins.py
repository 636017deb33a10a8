"""Twins of a scene: mirrored, larger, stiffer, or with other steps; their forces must agree."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.hard_cases.laws import at_most
from benchmarks.hard_cases.random_scenes.referee import (
    Held,
    elastic,
    largest,
    smooth,
    stated,
    weightless,
)
from sim.errors import SceneError
from sim.indenters import Indenter, Part
from sim.result import Result
from sim.scene import Body, Effects, Motion, Scene

Array = NDArray[np.float64]

# Allowed difference of forces over the largest, or the errors that both results state, if larger:
# symmetry error of default meshes.
AGREE = 0.02
# The same with friction, where a point that slips early or late affects others.
AGREE_RUBBING = 0.05
LARGER = 10.0
MIRRORS = ("mirror-x", "mirror-y", "swap-xy")


@dataclass(frozen=True, slots=True)
class Twin:
    """Another scene, with the forces that the first one predicts for it."""

    name: str
    scene: Scene
    forces: Callable[[Array], Array]
    """Maps forces (F, 3) [N] of the first scene to those of the twin; NaN where unknown."""


def agrees(result: Result, twin: Twin, other: Result) -> Held:
    """Return the law that both scenes have the same forces, within the errors that they state."""
    expected = twin.forces(result.force)
    ratio = _ratio(twin.scene, result.scene)
    scale = largest(result) * ratio
    gap = np.linalg.norm(other.force - expected, axis=1) / scale
    known = stated(other) + stated(result)[-len(gap) :] * ratio
    limit = np.maximum(AGREE if smooth(result.scene) else AGREE_RUBBING, known / scale)
    over = np.where(np.isnan(expected).any(axis=1), -np.inf, gap - limit)
    worst = int(np.argmax(over))
    law = at_most(f"{twin.name}: |difference| / largest", gap[worst], float(limit[worst]))
    return Held(f"twin-{twin.name}", law)


def symmetric(result: Result) -> list[Held]:
    """Return the laws of a scene that equals its mirror image: symmetric forces."""
    scene = result.scene
    found = [twin_of(scene, name) for name in MIRRORS]
    return [
        Held("symmetric", agrees(result, twin, result).law)
        for twin in found
        if twin is not None and twin.scene == scene
    ]


def _ratio(one: Scene, other: Scene) -> float:
    size = [scene.body.modulus * scene.body.thickness**2 for scene in (one, other)]
    return size[0] / size[1]


def twin_of(scene: Scene, name: str) -> Twin | None:
    """Return the twin of that name, or None if the scene has no such twin."""
    try:
        return KINDS[name](scene)
    except SceneError:  # beyond a limit
        return None


def _mirrored_x(scene: Scene) -> Twin | None:
    return _turned(scene, "mirror-x", (-1.0, 1.0), swap=False)


def _mirrored_y(scene: Scene) -> Twin | None:
    return _turned(scene, "mirror-y", (1.0, -1.0), swap=False)


def _swapped(scene: Scene) -> Twin | None:
    return _turned(scene, "swap-xy", (1.0, 1.0), swap=True)


def _turned(scene: Scene, name: str, signs: tuple[float, float], *, swap: bool) -> Twin | None:
    """Return the scene reflected in a vertical mirror."""

    def place(x: float, y: float) -> tuple[float, float]:
        x, y = signs[0] * x, signs[1] * y
        return (y, x) if swap else (x, y)

    indenter = _indenter(scene.indenter, place, swap=swap)
    if indenter is None:
        return None
    body = scene.body
    if swap:
        body = replace(body, size_x=body.size_y, size_y=body.size_x)
    tips = tuple((*place(x, y), z) for x, y, z in scene.motion.tip)
    gravity = scene.effects.gravity
    effects = scene.effects
    if gravity is not None:
        pull = gravity.acceleration
        turned = (*place(pull[0], pull[1]), pull[2])
        effects = replace(effects, gravity=replace(gravity, acceleration=turned))
    matrix = np.eye(3)
    matrix[:2, :2] = np.transpose([place(1.0, 0.0), place(0.0, 1.0)])
    mirrored = Scene(indenter, replace(scene.motion, tip=tips), body, effects)
    return Twin(name, mirrored, lambda force: force @ matrix.T)


def _indenter(
    indenter: Indenter, place: Callable[[float, float], tuple[float, float]], *, swap: bool
) -> Indenter | None:
    """Return the mirrored indenter, or None if its parts cannot represent it."""
    if indenter.solid is not None:
        return None
    parts = []
    for part in indenter.parts:
        mirrored = _part(part, place, swap=swap)
        if mirrored is None:
            return None
        parts.append(mirrored)
    x, y = place(*indenter.tilt)
    # An angle changes sign in a mirror, because its axis is a pseudovector.
    return replace(indenter, parts=tuple(parts), tilt=(-x, -y))


def _part(
    part: Part, place: Callable[[float, float], tuple[float, float]], *, swap: bool
) -> Part | None:
    if part.view == "turned":
        return replace(part, axis=place(*part.axis))
    values = part.values
    if part.view == "side":
        level = part.figure in ("half_plane", "band") and values[0] == 0.0
        if swap and not level:
            return None
        sign = place(1.0, 0.0)[0] if not swap else 1.0
        return replace(part, values=_figure(part, lambda u, v: (sign * u, v), turns=sign < 0))
    return replace(part, values=_figure(part, place, turns=True))


def _figure(
    part: Part, place: Callable[[float, float], tuple[float, float]], *, turns: bool
) -> tuple[float, ...]:
    if part.figure != "path":
        turned = place(part.values[0], part.values[1])
        if part.figure == "band" and turned < (0.0, 0.0):  # the same band with opposite sign
            return (0.0 - turned[0], 0.0 - turned[1], 0.0 - part.values[2], *part.values[3:])
        return (*turned, *part.values[2:])
    corners = [part.values[index : index + 3] for index in range(0, len(part.values), 3)]
    if not turns:
        return tuple(value for u, v, turn in corners for value in (*place(u, v), turn))
    # Reversed, so that the material stays on the left; an arc now belongs to its other corner.
    backwards = [(*place(u, v), corners[index - 1][2]) for index, (u, v, _) in enumerate(corners)]
    return tuple(value for corner in reversed(backwards) for value in corner)


def _larger(scene: Scene) -> Twin | None:
    """Return a twin ten times as large and stiff: weight over stiffness is kept, mass slows it."""
    factor = LARGER
    if scene.indenter.solid is not None or scene.indenter.name == "plane":
        return None
    body = scene.body
    sizes = (body.size_x, body.size_y, body.thickness)
    if max(sizes) * factor > 1.0 or body.modulus * factor > 1e9:
        factor = 1.0 / LARGER
        if min(sizes) * factor < 1e-4 or body.modulus * factor < 1e2:
            return None
    dome = None if body.dome_radius is None else body.dome_radius * factor
    larger = Body(
        body.size_x * factor, body.size_y * factor, body.thickness * factor,
        body.modulus * factor, body.poisson, dome, body.density,
        body.footprint,
    )  # fmt: skip
    slower = math.sqrt(factor) if scene.effects.inertia is not None else 1.0
    tips = tuple((x * factor, y * factor, z * factor) for x, y, z in scene.motion.tip)
    motion = Motion(tips, tuple(time * slower for time in scene.motion.time))
    viscosity = scene.effects.viscosity
    effects = scene.effects
    if viscosity is not None:
        times = tuple(time * slower for time in viscosity.times)
        effects = replace(effects, viscosity=replace(viscosity, times=times))
    twin = Scene(_scaled(scene.indenter, factor), motion, larger, effects)
    return Twin("ten-times", twin, lambda force: force * factor**3)


def _scaled(indenter: Indenter, factor: float) -> Indenter:
    def values(part: Part) -> tuple[float, ...]:
        first, second, *rest = part.values
        if part.figure == "circle":
            return tuple(value * factor for value in part.values)
        if part.figure == "path":
            return tuple(
                value if index % 3 == 2 else value * factor
                for index, value in enumerate(part.values)
            )
        return (first, second, *(value * factor for value in rest))

    parts = tuple(
        replace(part, values=values(part), axis=(part.axis[0] * factor, part.axis[1] * factor))
        for part in indenter.parts
    )
    return replace(
        indenter,
        parts=parts,
        edge_radius=indenter.edge_radius * factor,
        narrowest=indenter.narrowest * factor,
    )


def _at_once(scene: Scene) -> Twin | None:
    """Return the last frame alone, reached directly; elastic and without friction."""
    motion = scene.motion
    if not (elastic(scene) and smooth(scene) and weightless(scene)) or len(motion) < 3:
        return None
    x, y, z = motion.tip[-1]
    if z >= 0:
        return None
    way = Motion(((x, y, 0.0), (x, y, z)), (0.0, 1.0))
    twin = Scene(scene.indenter, way, scene.body, Effects())
    return Twin("at-once", twin, lambda force: np.stack([force[-1] * np.nan, force[-1]]))


# Constructor of the twin of each name.
KINDS: dict[str, Callable[[Scene], Twin | None]] = {
    "mirror-x": _mirrored_x,
    "mirror-y": _mirrored_y,
    "swap-xy": _swapped,
    "ten-times": _larger,
    "at-once": _at_once,
}
