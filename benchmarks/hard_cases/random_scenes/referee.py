"""Referee: laws of mechanics, measured on a result without using the solver.

`Result.quality` is not used. Laws that compare forces hold within the error that the result states;
bounds from mechanics and from the spectral layer are wide enough for it already.
A law that does not apply to a scene (for example a closed loop, or a static force with inertia) is
skipped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

from benchmarks.hard_cases.laws import Law, at_least, at_most
from benchmarks.hard_cases.random_scenes import bounds, overlap
from benchmarks.hard_cases.random_scenes.bounds import footprint, half_wall, inside_by
from sim.result import Result, force_scale
from sim.scene import Point

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


class Reading:
    """A result, with what several laws read from it; forces are in newtons."""

    def __init__(self, result: Result) -> None:
        """Read the result."""
        self.result, self.scene = result, result.scene
        body, effects = result.scene.body, result.scene.effects
        # No friction; no relaxation and no mass, so no memory; only the indenter loads the gel.
        self.smooth = not (effects.friction and effects.friction.coefficient)
        self.elastic = effects.viscosity is None and effects.inertia is None
        self.weightless = effects.gravity is None
        self.pressed = self.weightless and effects.inertia is None
        self.tips: tuple[Point, ...] = self.scene.motion.tip
        self.push: Array = -result.force[:, 2]
        self.size = np.linalg.norm(result.force, axis=1)
        self.nothing = FLOOR * body.modulus * body.thickness**2
        self.largest = max(float(self.size.max()), self.nothing)
        # Error that the result states for the force of each frame; 0 if none.
        error = result.record.get("error", {}).get("force") or np.zeros(len(self.size))
        self.stated: Array = np.asarray(error, float) * force_scale(result.force)
        # Undeformed area around each node, projected from above (X, Y) [m^2].
        sides = (np.diff(places) for places in (result.surface_x, result.surface_y))
        self.areas = np.outer(*(np.convolve(side, [0.5, 0.5]) for side in sides))

    @cached_property
    def loading(self) -> list[int]:
        """Frames deeper than all before, with the tip above its starting point."""
        frames, deepest = [], 0.0
        for frame, (x, y, z) in enumerate(self.tips):
            if max(abs(x - self.tips[0][0]), abs(y - self.tips[0][1])) > 1e-12:
                break
            if -z > deepest:
                deepest = -z
                frames.append(frame)
        return frames

    @cached_property
    def bounded(self) -> list[tuple[float, float, float]]:
        """Push of loading frames, its lower bound (0 for a first touch), and its upper bound."""
        least = max(TOUCH[0], TOUCH[1] * self.scene.body.thickness)
        rows = []
        for frame in self.loading if self.pressed else ():
            at = self.scene, self.tips[frame]
            lower = bounds.least_force(*at) if footprint(*at).deepest > least else 0.0
            rows.append((float(self.push[frame]), lower, bounds.most_force(*at)))
        return rows

    @cached_property
    def overlaps(self) -> list[tuple[float, float]]:
        """`overlap` of each frame."""
        return [overlap.overlap(self.result, frame) for frame in range(len(self.tips))]


def _least(says: str, values: Sequence[float], limit: float) -> list[Law]:
    return [at_least(says, min(values), limit)] if values else []


def _most(says: str, values: Sequence[float], limit: float) -> list[Law]:
    return [at_most(says, max(values), limit)] if values else []


def _above_base(it: Reading) -> list[Law]:
    """The skin stays above the base plane to which the gel is bonded."""
    body, result = it.scene.body, it.result
    rest = body.heights(result.surface_x, result.surface_y)
    least = float((rest + result.surface[..., 2]).min()) / body.thickness
    return [at_least("lowest place of the skin / thickness", least, -1.0 - BELOW)]


def _no_pull(it: Reading) -> list[Law]:
    """Contact does not pull, except slightly on a bar whose upper side is closed over by gel."""
    limit = PULL if it.smooth else 2 * PULL
    return [at_least("least push / largest force", it.push.min() / it.largest, -limit)]


def _lets_go(it: Reading) -> list[Law]:
    """There is no force if the indenter is clear of the undeformed gel."""
    scene = it.scene
    if not it.pressed:
        return []
    clear = 0.0 if it.elastic and it.smooth else -0.05 * scene.body.thickness
    if scene.indenter.solid is not None:
        clear -= OF_GRID * scene.indenter.solid.spacing
    free = [
        size / it.largest
        for size, tip in zip(it.size, it.tips, strict=True)
        if footprint(scene, tip).deepest <= clear
    ]
    return _most("force where nothing touches / largest", free, NOTHING)


def _touches(it: Reading) -> list[Law]:
    """There is a force if the indenter overlaps the undeformed gel."""
    some = [push / it.nothing for push, lower, _ in it.bounded if lower > it.nothing]
    return _least("push where gel is overlapped / none", some, 1.0)


def _within_bounds(it: Reading) -> list[Law]:
    """The push lies between the forces of discs inscribed in and around the indenter."""
    viscosity = it.scene.effects.viscosity
    stiffer = 1.0 + (sum(viscosity.ratios) if viscosity else 0.0)
    low = [push / lower for push, lower, _ in it.bounded if lower > it.nothing]
    high = [push / (upper * stiffer) for push, _, upper in it.bounded if upper > it.nothing]
    return [
        *_least("push / lower bound", low, bounds.LOWER),
        *_most("push / upper bound", high, bounds.UPPER),
    ]


def _near_layer(it: Reading) -> list[Law]:
    """A shallow press away from the rim has the force of the spectral layer."""
    if not (it.elastic and it.weightless):
        return []
    for frame in reversed(it.loading):
        layer = bounds.layer_force(it.scene, it.tips[frame])
        if layer is not None and layer > it.nothing:
            fraction = it.push[frame] / layer
            return [
                at_least("push / layer's", fraction, bounds.LAYER_LEAST),
                at_most("push / layer's, at most", fraction, bounds.LAYER_MOST),
            ]
    return []


def _rises(it: Reading) -> list[Law]:
    """A deeper press has a larger force: elastic, no friction, away from the rim, up to a third."""
    scene, thickness = it.scene, it.scene.body.thickness
    if not (it.elastic and it.smooth and it.weightless):
        return []
    shallow = [frame for frame in it.loading if -it.tips[frame][2] <= thickness / 3]
    some = [frame for frame in shallow if inside_by(scene, it.tips[frame], 0.5 * thickness)]
    if len(some) < 2:
        return []
    force, error = it.push[some], it.stated[some]
    top = max(float(np.abs(force).max()), it.nothing)
    rise, drop = np.diff(force) / top, np.maximum(DROP, (error[1:] + error[:-1]) / top)
    least = int(np.argmin(rise + drop))
    return [at_least("least rise with depth / largest", rise[least], -float(drop[least]))]


def _same_place(it: Reading) -> list[Law]:
    """Elastic, no friction: equal tip positions have equal forces, on any path."""
    if not (it.elastic and it.smooth):
        return []
    tips, force = np.asarray(it.tips), it.result.force
    error = it.stated / it.largest
    laws = [
        at_most(
            "difference at one place / largest force",
            float(np.linalg.norm(force[a] - force[b])) / it.largest,
            max(SAME, float(error[a] + error[b])),
        )
        for a, b in combinations(range(len(tips)), 2)
        if np.abs(tips[a] - tips[b]).max() < 1e-12
    ]
    return [max(laws, key=lambda law: law.measured / law.limit)] if laws else []


def _closed_loop(it: Reading) -> list[Law]:
    """A closed path returns no more work than it took; an elastic one returns all of it."""
    scene, tips = it.scene, np.asarray(it.tips)
    ends = [
        end
        for end in range(3, len(tips) + 1)
        if np.abs(tips[:end] - tips[:end][::-1]).max() < 1e-12
        and np.abs(tips[:end] - tips[0]).max() > 0
    ]
    if not ends or scene.effects.inertia is not None:
        return []
    end = ends[-1]
    works = cumulative_trapezoid(it.result.force[:end], tips[:end], axis=0).sum(axis=1)
    most = max(float(works.max()), it.nothing * scene.body.thickness)
    fraction, limit = float(works[-1]) / most, RING[0] if it.smooth else RING[1]
    laws = [at_least("work in a closed loop / most", fraction, -limit)]
    if it.elastic and it.smooth:
        laws.append(at_most("work in an elastic loop / most", fraction, limit))
    return laws


def _coulomb(it: Reading) -> list[Law]:
    """Nodal forces, resolved along the indenter's normals, obey Coulomb's law and do not pull.

    Only where the mesh resolves it: a contact of many nodes without narrow or sharp parts.
    """
    scene, result = it.scene, it.result
    friction = scene.effects.friction
    coefficient = friction.coefficient if friction else 0.0
    element = max(np.diff(result.surface_x).min(), np.diff(result.surface_y).min())
    radius = scene.indenter.sharpest
    if half_wall(scene) < 2 * element or radius < element:
        return []
    shears, pulls = [], []
    for frame, tip in enumerate(it.tips):
        force = result.traction[frame].astype(float) * it.areas[..., None]
        loaded = np.linalg.norm(force, axis=-1)
        many = (loaded > 0.2 * loaded.max()).sum() >= NODES
        if not many or it.size[frame] <= max(0.05 * it.largest, it.nothing):
            continue
        _, normal = scene.indenter.distance(overlap.deformed(result, frame) - np.asarray(tip))
        pressure = np.einsum("...i,...i->...", force, normal)
        shear = np.linalg.norm(force - pressure[..., None] * normal, axis=-1)
        # The rest is on the sides, which are not in the result.
        if pressure.sum() > 0.8 * it.size[frame] / math.hypot(1.0, coefficient):
            shears.append(float(shear.sum() / pressure.sum()))
            pulls.append(float(-np.minimum(pressure, 0.0).sum() / pressure.sum()))
    limit = math.hypot(max(SHEAR, EDGE * element / radius), coefficient)
    return [
        *_most("sum of shear / sum of pressure", shears, limit),
        *_most("sum of tension / sum of pressure", pulls, TENSION),
    ]


def _sums_up(it: Reading) -> list[Law]:
    """Tractions on the top add up to the force if the whole contact is on the top."""
    body = it.scene.body
    totals = np.einsum("fijk,ij->fk", it.result.traction.astype(float), it.areas)
    gaps = np.linalg.norm(totals - it.result.force, axis=1)
    some = [
        gap / size
        for gap, size, tip in zip(gaps, it.size, it.tips, strict=True)
        if size >= max(0.02 * it.largest, it.nothing)
        and body.dome_radius is None
        and inside_by(it.scene, tip, 0.5 * body.thickness)
    ]
    return _most("|sum of tractions - force| / force", some, SUM)


def _through_centre(it: Reading) -> list[Law]:
    """Without friction, the force on a sphere passes through its centre."""
    indenter = it.scene.indenter
    upright_sphere = indenter.name in ("sphere", "sphere_s") and indenter.tilt == (0.0, 0.0)
    if not (it.smooth and upright_sphere):
        return []
    radius = indenter.sharpest
    expected = np.cross([0.0, 0.0, radius], it.result.force)
    gap = float(np.linalg.norm(it.result.wrench[:, 3:] - expected, axis=1).max())
    return [at_most("torque about the centre / force radius", gap / (radius * it.largest), LEVER)]


def _no_overlap(it: Reading) -> list[Law]:
    """The deformed top is not inside the indenter."""
    some = [deep / overlap.allowed(it.result, frame) for frame, (deep, _) in enumerate(it.overlaps)]
    return _most("overlap / what a mesh may leave", some, 1.0)


def _not_through(it: Reading) -> list[Law]:
    """The gel is not above the indenter's lower side, as after a wall has passed through it."""
    some = [
        above / -tip[2]
        for (_, above), tip in zip(it.overlaps, it.tips, strict=True)
        if tip[2] < -3 * overlap.SMALL
    ]
    return _most("gel above the lower side / depth", some, overlap.THROUGH)


def _no_crossing(it: Reading) -> list[Law]:
    """No skin passes through a wall from one side to the other between frames."""
    limit = half_wall(it.scene)
    frames = range(1, len(it.tips) if math.isfinite(limit) else 0)
    ways = [overlap.crossed(it.result, frame) / limit for frame in frames]
    return _most("way through a wall / half of it", ways, overlap.OF_WALL)


# Laws of one result; those of two results are in `twins`.
_FUNCTIONS = (
    _above_base, _no_pull, _lets_go, _touches, _within_bounds, _near_layer, _rises, _same_place,
    _closed_loop, _coulomb, _sums_up, _through_centre, _no_overlap, _not_through, _no_crossing,
)  # fmt: skip
LAWS: dict[str, Callable[[Reading], list[Law]]] = {
    law.__name__.strip("_").replace("_", "-"): law for law in _FUNCTIONS
}
# A law with its name.
Named = tuple[str, Law]


def measured(result: Result) -> list[Named]:
    """Measure all laws that apply to the result; only the first if a number is not finite."""
    values = result.wrench, result.surface, result.traction
    wrong = int(sum((~np.isfinite(value)).sum() for value in values))
    finite: list[Named] = [("finite", at_most("numbers that are not finite", wrong, 0))]
    it = Reading(result)
    return finite + [(name, law) for name, each in LAWS.items() if not wrong for law in each(it)]
