"""Referee: laws of mechanics, measured on a result without using the solver.

`Result.quality` is not used. Laws that compare forces hold within the error that the result states;
bounds from mechanics and from the spectral layer are wide enough for it already.
A law that does not apply to a scene (for example a closed loop, or a static force with inertia) is
skipped.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from benchmarks.hard_cases.laws import Law, at_least, at_most
from benchmarks.hard_cases.random_scenes import bounds, overlap
from benchmarks.hard_cases.random_scenes.footprint import footprint, half_wall, inside_by
from sim.result import Result, force_scale
from sim.scene import Scene

Array = NDArray[np.float64]

# Negligible force, in modulus times thickness squared: 0.2 uN in the paper's gel.
FLOOR = 1e-7
# Overlap with the undeformed gel above which a force is required [m], and in thicknesses.
TOUCH = 1e-6, 2.5e-4
# Negligible fraction of the largest force.
NOTHING = 1e-3
# Accuracy of a solid's surface, in spacings of its grid.
OF_GRID = 0.02
# Allowed difference of two frames of an elastic gel at one place, or the errors that the result
# states for both, if larger: on a coarse mesh an edge may rest on either side of a node.
SAME = 0.01
# Fraction of the largest force by which the force of a deeper press may be lower; again the stated
# errors, if larger.
DROP = 0.005
# Work that a closed loop may give back or, if elastic, absorb, over the maximum work: without and
# with friction (trapezoid rule over a few frames).
RING = 0.02, 0.05
# Shear over pressure without friction, and the minimum number of loaded nodes: nodal forces combine
# contact points with different normals, which gives 0.03 to 0.16 on a coarse mesh, and with
# friction adds as a sum of squares. On an edge normals turn by an element over its radius, which
# gives 0.24 to 0.29 times that angle (scene 157 of seed 23, three meshes).
SHEAR, EDGE, NODES = 0.2, 0.4, 9
# Total pull over the largest force, and tension over pressure at nodes.
PULL, TENSION = 0.05, 0.02
# Sum of tractions relative to the force, and torque relative to that of the force (rounding).
SUM, LEVER = 0.02, 0.02
# Maximum depth of the skin below the base plane, in thicknesses.
BELOW = 1e-3


@dataclass(frozen=True, slots=True)
class Held:
    """A law with its name and measurement."""

    name: str
    law: Law


def held(result: Result) -> list[Held]:
    """Measure all laws that apply to the result."""
    if not _finite(result):
        return [Held("finite", at_most("numbers that are not finite", _not_finite(result), 0))]
    found = [Held("finite", at_most("numbers that are not finite", 0, 0))]
    for name, law in LAWS.items():
        found += [Held(name, one) for one in law(result)]
    return found


def _finite(result: Result) -> bool:
    return _not_finite(result) == 0


def _not_finite(result: Result) -> int:
    values = result.wrench, result.surface, result.traction
    return int(sum((~np.isfinite(value)).sum() for value in values))


# Properties of a scene.


def elastic(scene: Scene) -> bool:
    """Return True if the gel has no memory: no relaxation, no mass."""
    return scene.effects.viscosity is None and scene.effects.inertia is None


def smooth(scene: Scene) -> bool:
    """Return True if there is no friction."""
    friction = scene.effects.friction
    return friction is None or friction.coefficient == 0


def weightless(scene: Scene) -> bool:
    """Return True if only the indenter loads the gel."""
    return scene.effects.gravity is None


def no_force(scene: Scene) -> float:
    """Return the negligible force [N]."""
    return FLOOR * scene.body.modulus * scene.body.thickness**2


def pushes(result: Result) -> Array:
    """Return the downward push of the indenter by frame (F,) [N]."""
    return -result.force[:, 2]


def largest(result: Result) -> float:
    """Return the magnitude of the largest force [N], at least the negligible force."""
    return max(float(np.linalg.norm(result.force, axis=1).max()), no_force(result.scene))


def stated(result: Result) -> Array:
    """Return the error that the result states for the force of each frame (F,) [N]; 0 if none."""
    fraction = result.record.get("error", {}).get("force") or [0.0] * len(result.force)
    return np.asarray(fraction, float) * force_scale(result.force)


def loading(result: Result) -> list[int]:
    """Return the frames deeper than all before, with the tip above its starting point."""
    tips = np.asarray(result.scene.motion.tip, float)
    found, deepest = [], 0.0
    for frame, tip in enumerate(tips):
        if np.abs(tip[:2] - tips[0, :2]).max() > 1e-12:
            break
        if -tip[2] > deepest:
            deepest = -tip[2]
            found.append(frame)
    return found


# The laws.


def _above_base(result: Result) -> list[Law]:
    """The skin stays above the base plane to which the gel is bonded."""
    body = result.scene.body
    rest = body.heights(result.surface_x, result.surface_y)
    least = float((rest + result.surface[..., 2]).min()) / body.thickness
    return [at_least("lowest place of the skin / thickness", least, -1.0 - BELOW)]


def _no_pull(result: Result) -> list[Law]:
    """Contact does not pull, except slightly on a bar whose upper side is closed over by gel."""
    fraction = float(pushes(result).min()) / largest(result)
    limit = PULL if smooth(result.scene) else 2 * PULL
    return [at_least("least push / largest force", fraction, -limit)]


def _lets_go(result: Result) -> list[Law]:
    """There is no force if the indenter is clear of the undeformed gel."""
    scene = result.scene
    if scene.effects.inertia is not None or not weightless(scene):
        return []
    clear = 0.0 if elastic(scene) and smooth(scene) else -0.05 * scene.body.thickness
    if scene.indenter.solid is not None:
        clear -= OF_GRID * scene.indenter.solid.spacing
    size = np.linalg.norm(result.force, axis=1)
    free = [
        size[frame]
        for frame, tip in enumerate(bounds.reached(result))
        if footprint(scene, tip).deepest <= clear
    ]
    if not free:
        return []
    fraction = float(max(free)) / largest(result)
    return [at_most("force where nothing touches / largest", fraction, NOTHING)]


def _touches(result: Result) -> list[Law]:
    """There is a force if the indenter overlaps the undeformed gel."""
    scene = result.scene
    if not (weightless(scene) and scene.effects.inertia is None):
        return []
    some = [
        frame for frame in loading(result)
        if _resolved(scene, bounds.reached(result)[frame])
        and bounds.least_force(scene, bounds.reached(result)[frame]) > no_force(scene)
    ]  # fmt: skip
    if not some:
        return []
    least_push = float(pushes(result)[some].min()) / no_force(scene)
    return [at_least("push where gel is overlapped / none", least_push, 1.0)]


def _resolved(scene: Scene, tip: tuple[float, float, float]) -> bool:
    """Return True if the indenter overlaps the undeformed gel by more than a first touch."""
    return footprint(scene, tip).deepest > max(TOUCH[0], TOUCH[1] * scene.body.thickness)


def _within_bounds(result: Result) -> list[Law]:
    """The push lies between the forces of discs inscribed in and around the indenter."""
    scene = result.scene
    if not weightless(scene) or scene.effects.inertia is not None:
        return []
    viscosity = scene.effects.viscosity
    stiffer = 1.0 + (sum(viscosity.ratios) if viscosity else 0.0)
    low, high = [], []
    for frame in loading(result):
        tip = bounds.reached(result)[frame]
        push = float(pushes(result)[frame])
        least, most = bounds.least_force(scene, tip), bounds.most_force(scene, tip)
        if least > no_force(scene) and _resolved(scene, tip):
            low.append(push / least)
        if most > no_force(scene) and half_wall(scene) > 0:
            high.append(push / (most * stiffer))
    laws = [at_least("push / lower bound", min(low), bounds.LOWER)] if low else []
    return laws + ([at_most("push / upper bound", max(high), bounds.UPPER)] if high else [])


def _near_layer(result: Result) -> list[Law]:
    """A shallow press away from the rim has the force of the spectral layer."""
    scene = result.scene
    if not (elastic(scene) and weightless(scene)):
        return []
    for frame in reversed(loading(result)):
        tip = bounds.reached(result)[frame]
        layer = bounds.layer_force(scene, tip)
        if layer is not None and layer > no_force(scene):
            fraction = float(pushes(result)[frame]) / layer
            return [
                at_least("push / layer's", fraction, bounds.LAYER_LEAST),
                at_most("push / layer's, at most", fraction, bounds.LAYER_MOST),
            ]
    return []


def _rises(result: Result) -> list[Law]:
    """A deeper press has a larger force: elastic, no friction, away from the rim, up to a third."""
    scene = result.scene
    if not (elastic(scene) and smooth(scene) and weightless(scene)):
        return []
    tips = bounds.reached(result)
    some = [
        frame for frame in loading(result)
        if -tips[frame][2] <= scene.body.thickness / 3
        and inside_by(scene, tips[frame], 0.5 * scene.body.thickness)
    ]  # fmt: skip
    if len(some) < 2:
        return []
    force, error = pushes(result)[some], stated(result)[some]
    top = max(float(np.abs(force).max()), no_force(scene))
    rise, drop = np.diff(force) / top, np.maximum(DROP, (error[1:] + error[:-1]) / top)
    least = int(np.argmin(rise + drop))
    return [at_least("least rise with depth / largest", rise[least], -float(drop[least]))]


def _same_place(result: Result) -> list[Law]:
    """Elastic, no friction: equal tip positions have equal forces, on any path."""
    scene = result.scene
    if not (elastic(scene) and smooth(scene)):
        return []
    tips = np.asarray(scene.motion.tip, float)
    pairs = [
        (one, other) for one, other in combinations(range(len(tips)), 2)
        if np.abs(tips[one] - tips[other]).max() < 1e-12
    ]  # fmt: skip
    if not pairs:
        return []
    error = stated(result) / largest(result)
    laws = [
        at_most(
            "difference at one place / largest force",
            float(np.linalg.norm(result.force[a] - result.force[b])) / largest(result),
            max(SAME, float(error[a] + error[b])),
        )
        for a, b in pairs
    ]
    return [max(laws, key=lambda law: law.measured / law.limit)]


def _closed_loop(result: Result) -> list[Law]:
    """A closed path returns no more work than it took; an elastic one returns all of it."""
    scene = result.scene
    tips = np.asarray(scene.motion.tip, float)
    if scene.effects.inertia is not None:
        return []
    for end in range(len(tips), 2, -1):
        way = tips[:end]
        if np.abs(way - way[::-1]).max() < 1e-12 and np.abs(way - way[0]).max() > 0:
            break
    else:
        return []
    force = result.force[:end]
    parts = np.einsum("ij,ij->i", (force[1:] + force[:-1]) / 2, np.diff(way, axis=0))
    most = max(float(np.cumsum(parts).max()), no_force(scene) * scene.body.thickness)
    fraction = float(parts.sum()) / most
    limit = RING[0] if smooth(scene) else RING[1]
    laws = [at_least("work in a closed loop / most", fraction, -limit)]
    if elastic(scene) and smooth(scene):
        laws.append(at_most("work in an elastic loop / most", fraction, limit))
    return laws


def _coulomb(result: Result) -> list[Law]:
    """Nodal forces, resolved along the indenter's normals, obey Coulomb's law and do not pull.

    Only where the mesh resolves it: a contact of many nodes without narrow or sharp parts.
    """
    scene = result.scene
    friction = scene.effects.friction
    coefficient = friction.coefficient if friction else 0.0
    element = max(np.diff(result.surface_x).min(), np.diff(result.surface_y).min())
    if half_wall(scene) < 2 * element or rounding(scene) < element:
        return []
    limit = math.hypot(max(SHEAR, EDGE * element / rounding(scene)), coefficient)
    shears, pulls = [], []
    for frame, tip in enumerate(bounds.reached(result)):
        size = float(np.linalg.norm(result.force[frame]))
        force = result.traction[frame].astype(float) * _areas(result)[..., None]
        loaded = np.linalg.norm(force, axis=-1)
        many = (loaded > 0.2 * loaded.max()).sum() >= NODES
        if size < 0.05 * largest(result) or size <= no_force(scene) or not many:
            continue
        x, y = np.meshgrid(result.surface_x, result.surface_y, indexing="ij")
        rest = np.stack([x, y, scene.body.heights(result.surface_x, result.surface_y)], axis=-1)
        _, normal = scene.indenter.distance(rest + result.surface[frame] - np.asarray(tip))
        pressure = np.einsum("...i,...i->...", force, normal)
        shear = np.linalg.norm(force - pressure[..., None] * normal, axis=-1)
        if pressure.sum() > 0.8 * size / math.hypot(
            1.0, coefficient
        ):  # the rest is on the sides, which are not in the result
            shears.append(float(shear.sum() / pressure.sum()))
            pulls.append(float(-np.minimum(pressure, 0.0).sum() / pressure.sum()))
    if not shears:
        return []
    return [
        at_most("sum of shear / sum of pressure", max(shears), limit),
        at_most("sum of tension / sum of pressure", max(pulls), TENSION),
    ]


def rounding(scene: Scene) -> float:
    """Return the radius of the indenter's edges [m]; inf if it has none."""
    indenter = scene.indenter
    edges = len(indenter.parts) > 1 or any(part.figure == "path" for part in indenter.parts)
    return indenter.edge_radius if edges or indenter.solid is not None else math.inf


def _areas(result: Result) -> Array:
    """Return the undeformed area around each node, projected from above (X, Y) [m^2]."""
    sides = [
        np.convolve(np.diff(places), [0.5, 0.5]) for places in (result.surface_x, result.surface_y)
    ]
    return np.outer(*sides)


def _sums_up(result: Result) -> list[Law]:
    """Tractions on the top add up to the force if the whole contact is on the top."""
    scene = result.scene
    gaps = []
    for frame, tip in enumerate(bounds.reached(result)):
        size = float(np.linalg.norm(result.force[frame]))
        if scene.body.dome_radius is not None or size < 0.02 * largest(result):
            continue
        if not inside_by(scene, tip, 0.5 * scene.body.thickness) or size <= no_force(scene):
            continue
        total = np.einsum("ijk,ij->k", result.traction[frame].astype(float), _areas(result))
        gaps.append(float(np.linalg.norm(total - result.force[frame])) / size)
    return [at_most("|sum of tractions - force| / force", max(gaps), SUM)] if gaps else []


def _through_centre(result: Result) -> list[Law]:
    """Without friction, the force on a sphere passes through its centre."""
    scene = result.scene
    parts = scene.indenter.parts
    if not smooth(scene) or len(parts) != 1 or scene.indenter.tilt != (0.0, 0.0):
        return []
    (part,) = parts
    if (part.view, part.figure, part.values[0]) != ("turned", "circle", 0.0) or any(part.axis):
        return []
    radius = parts[0].values[2]
    expected = np.cross([0.0, 0.0, radius], result.force)
    gap = float(np.linalg.norm(result.wrench[:, 3:] - expected, axis=1).max())
    fraction = gap / (radius * largest(result))
    return [at_most("torque about the centre / force radius", fraction, LEVER)]


def _no_overlap(result: Result) -> list[Law]:
    """The deformed top is not inside the indenter."""
    fractions = [
        overlap.overlap(result, frame).normal / overlap.allowed(result, frame)
        for frame in range(len(result.scene.motion))
    ]
    return [at_most("overlap / what a mesh may leave", max(fractions), 1.0)]


def _not_through(result: Result) -> list[Law]:
    """The gel is not above the indenter's lower side, as after a wall has passed through it."""
    fractions = [
        overlap.overlap(result, frame).upright / -tip[2]
        for frame, tip in enumerate(bounds.reached(result))
        if tip[2] < -3 * overlap.SMALL
    ]
    if not fractions:
        return []
    return [at_most("gel above the lower side / depth", max(fractions), overlap.THROUGH)]


def _no_crossing(result: Result) -> list[Law]:
    """No skin passes through a wall from one side to the other between frames."""
    ways = [overlap.crossed(result, frame) for frame in range(1, len(result.scene.motion))]
    limit = half_wall(result.scene)
    if not ways or not math.isfinite(limit):
        return []
    return [at_most("way through a wall / half of it", max(ways) / limit, overlap.OF_WALL)]


# Laws of one result; those of two results are in `twins`.
LAWS: dict[str, Callable[[Result], list[Law]]] = {
    "above-base": _above_base,
    "no-pull": _no_pull,
    "lets-go": _lets_go,
    "touches": _touches,
    "within-bounds": _within_bounds,
    "near-layer": _near_layer,
    "rises": _rises,
    "same-place": _same_place,
    "closed-loop": _closed_loop,
    "coulomb": _coulomb,
    "sums-up": _sums_up,
    "through-centre": _through_centre,
    "no-overlap": _no_overlap,
    "not-through": _not_through,
    "no-crossing": _no_crossing,
}
