"""Upper bounds of the change that an effect can cause, from dimensions and a `layer` run.

None of these bounds solves the effect: inertia and gravity are accelerations under which a layer
sags, viscosity is overstress that has not yet relaxed, friction is at most its coefficient. Factors
are conservative, and scenes outside the model of a layer without sides have no bound.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.fem.stepping import path_of
from sim.layer import Layer
from sim.metrics import Outcome, marker_pixels, outcome_of, pixels_of
from sim.result import force_scale
from sim.scene import Body, Effects, Inertia, Scene
from sim.tiers import simulate

Array = NDArray[np.float64]

# Largest slope of a force over depth, over force / depth: 1 for a flat punch, 1.5 for a sphere, 2
# for a cone, more as the layer fills up.
STIFFENING = 3.0
# Largest change of the force by friction, as a fraction, over its coefficient: 1 on a flat contact.
ALONG = 3.0
# Coefficient above which friction has no bound: its effect may be of any size.
SLIPPERY = 0.01


@dataclass(frozen=True, slots=True)
class Change:
    """Difference between two solutions of one scene; F frames."""

    fraction: tuple[float, ...]
    """Change of the force along x, y or z of each frame, over `sim.result.force_scale` (F,)."""
    force: float
    """Largest change of the force along x, y or z [N]."""
    marker: float
    """Root mean square of the distances between 14 x 14 markers' images, largest frame [px]."""

    def value(self, kind: str) -> float:
        """Return the number that a tolerance of `kind` ("fraction", "force", "marker") limits."""
        return max(self.fraction, default=0.0) if kind == "fraction" else float(getattr(self, kind))

    def times(self, factor: float) -> Change:
        """Return the change scaled by `factor`."""
        fraction = tuple(factor * one for one in self.fraction)
        return Change(fraction, factor * self.force, factor * self.marker)

    def plus(self, other: Change) -> Change:
        """Return the sum of both changes."""
        fraction = tuple(a + b for a, b in zip(self.fraction, other.fraction, strict=True))
        return Change(fraction, self.force + other.force, self.marker + other.marker)


def no_change(scene: Scene) -> Change:
    """Return the change by leaving out an effect of zero strength."""
    return Change((0.0,) * len(scene.motion), 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class _Layer:
    """Solution by the `layer` tier of a scene without the effects to be bounded."""

    outcome: Outcome
    scale: Array
    """Force by which errors of the force are divided (F,) [N]."""
    size: Array
    """Magnitude of the force (F,) [N]."""
    moved: float
    """Root mean square of the markers' displacement, largest frame [px]."""
    pixels: float
    """Largest shift of a marker's image per displacement of the marker [px/m]."""

    def change(self, newton: Array, pixels: float) -> Change:
        """Return the change for forces that change by `newton` (F,) and markers by `pixels`."""
        fraction = tuple(float(one) for one in newton / self.scale)
        return Change(fraction, float(newton.max(initial=0.0)), pixels)

    @property
    def width(self) -> float:
        """Square root of the area touched in the frame of the largest force [m]."""
        x, y = self.outcome.surface_x, self.outcome.surface_y
        touched = self.outcome.touched[int(np.argmax(self.size))].sum()
        return math.sqrt(float(touched * np.diff(x).mean() * np.diff(y).mean()))


def bounds_of(scene: Scene, names: Sequence[str]) -> dict[str, Change]:
    """Return upper bounds of the changes by leaving out each of the effects `names` of `scene`.

    Effects of zero strength change nothing. Others have a bound if the scene is within the model of
    `layer`: a flat body, an indenter that presses and stays a thickness away from the sides, a
    motion that does not begin inside the body. Names without a bound are absent.
    """
    bounds: dict[str, Change] = {}
    for name in names:
        effect = getattr(scene.effects, name)
        if effect == effect.weakened(0.0):
            bounds[name] = no_change(scene)
    friction = scene.effects.friction
    grips = friction is not None and friction.coefficient > SLIPPERY
    rest = [name for name in names if name not in bounds and not (grips and name == "friction")]
    layer = _layer(scene) if rest else None
    if layer is not None:
        bounds |= {name: _BOUNDS[name](scene, layer) for name in rest}
    return bounds


def _layer(scene: Scene) -> _Layer | None:
    """Return the solution of the scene by `layer`; None if it is not reliable."""
    depth, thickness = scene.motion.depth_max, scene.body.thickness
    if scene.body.dome_radius is not None or not 0 < depth < thickness:
        return None
    if scene.motion.tip[0][2] < 0:
        return None
    try:
        alone = replace(scene, effects=Effects(friction=scene.effects.friction))
        result = simulate(alone, Layer())
    except (SceneError, SimulationDiverged):
        return None
    outcome = outcome_of(result)
    size = np.linalg.norm(outcome.force, axis=1)
    if result.record["error"]["status"] == "none" or not size.any():
        return None
    at_rest = replace(outcome, surface=np.zeros_like(outcome.surface))
    moved = marker_pixels(outcome, scene.body) - marker_pixels(at_rest, scene.body)
    rms = np.sqrt(np.mean(np.sum(moved**2, axis=-1), axis=(1, 2)))
    return _Layer(
        outcome, force_scale(outcome.force), size, float(rms.max()), _pixels_per_metre(scene.body)
    )


def _pixels_per_metre(body: Body) -> float:
    """Return the largest shift of a marker's image per small displacement of the marker [px/m]."""
    corner = np.array([body.size_x / 2, body.size_y / 2, 0.0])
    step = 1e-6
    ways = [pixels_of(corner + step * axis) - pixels_of(corner) for axis in np.eye(3)]
    return float(np.linalg.norm(ways)) / step


def _friction(scene: Scene, layer: _Layer) -> Change:
    """Bound friction: traction is at most coefficient * pressure, and shears the full thickness."""
    friction = scene.effects.friction
    assert friction is not None
    pull = ALONG * friction.coefficient * layer.size
    pressure = float(layer.size.max()) / layer.width**2
    aside = friction.coefficient * pressure * scene.body.thickness / scene.body.shear_modulus
    marker = ALONG * friction.coefficient * layer.moved + layer.pixels * aside
    return layer.change(pull, marker)


def _viscosity(scene: Scene, layer: _Layer) -> Change:
    """Bound overstress: each branch adds its fraction of all changes of force not yet relaxed.

    Within a segment the force changes as in `layer`, and under a sliding contact the skin is loaded
    and unloaded once per width. A branch keeps exp(-t / time) of a change, and the mean of that for
    an even change over t (Taylor, Pister & Goudreau, Int. J. Numer. Meth. Eng. 2 (1970) 45).
    """
    viscosity = scene.effects.viscosity
    assert viscosity is not None
    tip, time = np.array(scene.motion.tip), np.array(scene.motion.time)
    size, force = layer.size, layer.outcome.force
    over = np.zeros(len(size))
    for ratio, relaxation in zip(viscosity.ratios, viscosity.times, strict=True):
        held = np.zeros(len(size))
        for k in range(1, len(size)):
            span = float(time[k] - time[k - 1]) / relaxation
            aside = float(np.linalg.norm(tip[k, :2] - tip[k - 1, :2]))
            pressed = max(size[k], size[k - 1])
            change = np.linalg.norm(force[k] - force[k - 1]) + 2 * pressed * aside / layer.width
            fresh = STIFFENING * change * -math.expm1(-span) / span
            held[k] = held[k - 1] * math.exp(-span) + fresh
        over += ratio * np.minimum(held, STIFFENING * size.max())
    return layer.change(over, float((over / layer.scale).max()) * layer.moved)


def _gravity(scene: Scene, layer: _Layer) -> Change:
    gravity = scene.effects.gravity
    assert gravity is not None
    steady = np.tile(np.array(gravity.acceleration, float), (len(layer.size), 1))
    return _of_acceleration(scene, layer, steady, moving=False)


def _inertia(scene: Scene, layer: _Layer) -> Change:
    inertia = scene.effects.inertia
    assert inertia is not None
    most = inertia.scale * _accelerations(scene, inertia)[:, None] * np.ones(3)
    return _of_acceleration(scene, layer, most, moving=True)


def _accelerations(scene: Scene, inertia: Inertia) -> Array:
    """Return the largest acceleration of the material at each frame (F,) [m/s^2].

    A change of the tip's velocity acts within a step, or at the speed of a wave through the
    thickness if that is slower. The vibration that follows is damped by 1 / sqrt(1 + (omega
    step)^2) in each step of backward Euler, omega being the lowest frequency of a layer or of a
    bending column. In addition, the velocity field changes with the contact over the time of a
    segment.
    """
    body, motion = scene.body, scene.motion
    density = body.density * inertia.scale
    narrow = min(body.size_x, body.size_y) / body.thickness
    shear = math.pi / 2 * math.sqrt(body.shear_modulus / density) / body.thickness
    bend = 1.015 * narrow * math.sqrt(body.modulus / density) / body.thickness
    omega = min(shear, bend)
    wave = math.sqrt((body.bulk_modulus + 4 / 3 * body.shear_modulus) / density) / body.thickness
    path = path_of(scene, Fem())
    tip, time = np.array(motion.tip), np.array(motion.time)
    velocity = np.diff(tip, axis=0) / np.diff(time)[:, None]
    accelerations = np.zeros(len(tip))
    rings, before = 0.0, np.zeros(3)
    for k, ((start, end), now) in enumerate(zip(pairwise(tip), velocity, strict=True), 1):
        path.segment = k
        duration = float(time[k] - time[k - 1])
        step = path.limit * duration
        steps = round(1 / path.limit)
        lost = 1 / math.sqrt(1 + (omega * step) ** 2)
        jump = float(np.linalg.norm(now - before)) * min(1 / step, wave)
        # Above the skin there is no effect; a contact made within the segment is not yet damped.
        met = start[2] > 0 > end[2]
        fresh = (
            float(np.linalg.norm(now)) * min(1 / step, wave) if met else jump * lost ** (steps - 1)
        )
        rings = rings * lost**steps + fresh
        accelerations[k] = rings + STIFFENING * float(np.linalg.norm(now)) / duration
        before = now
    return accelerations


def _of_acceleration(scene: Scene, layer: _Layer, most: Array, *, moving: bool) -> Change:
    """Return the change by accelerations (F, 3) [m/s^2] of the whole body.

    The body sags: along z as a block bonded below (Gent's apparent modulus, or that of confined
    columns if it is less), sideways in shear and bending. The contact becomes deeper or shallower
    by that, and stiffer by the ratio of the stress of the weight to the modulus. With `moving` the
    indenter also accelerates the mass around it.
    """
    body, depth = scene.body, scene.motion.depth_max
    thick = body.thickness
    shape = body.size_x * body.size_y / (4 * thick * (body.size_x + body.size_y))
    confined = body.bulk_modulus + 4 / 3 * body.shear_modulus
    along = min(confined, body.modulus * (1 + 2 * shape**2))
    narrow = min(body.size_x, body.size_y) / thick
    weight = body.density * thick
    down = weight * np.abs(most[:, 2]) * thick / (2 * along)
    side = np.linalg.norm(most[:, :2], axis=1) * weight * thick
    aside = side * (1 / (2 * body.shear_modulus) + 1.5 / (body.modulus * narrow**2))
    sag = down + aside
    pulled = np.linalg.norm(most, axis=1)
    deep = np.maximum(-np.array(scene.motion.tip)[:, 2], 1e-6 * depth)
    slope = np.maximum(STIFFENING * layer.size / deep, float(layer.size.max()) / depth)
    newton = slope * sag / (1 - depth / thick) + layer.size * weight * pulled / body.modulus
    if moving:
        area = min((layer.width + 2 * thick) ** 2, body.size_x * body.size_y)
        newton = newton + weight * area * pulled
    return layer.change(newton, 2 * layer.pixels * float(sag.max()))


_BOUNDS: dict[str, Callable[[Scene, _Layer], Change]] = {
    "friction": _friction,
    "viscosity": _viscosity,
    "inertia": _inertia,
    "gravity": _gravity,
}
