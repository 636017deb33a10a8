"""Laws of mechanics, measured on a result without using the solver.

`Result.quality` is not used. Laws that compare forces hold within the error that the result states;
bounds from mechanics and from the spectral layer are wide enough for it already.
A law that does not apply to a scene (for example a closed loop, or a static force with inertia) is
skipped.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from functools import cached_property
from itertools import combinations, pairwise

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.ndimage import distance_transform_edt

from benchmarks.hard_cases.laws import Array, Law, Laws, at_least, at_most
from benchmarks.hard_cases.random_scenes import geometry
from benchmarks.hard_cases.random_scenes.geometry import footprint, half_wall, inside_by
from sim.error_estimate import PLANES, planes_of
from sim.errors import SceneError, SimulationDiverged
from sim.layer import Layer
from sim.result import Result, force_scale
from sim.scene import Motion, Point, Scene
from sim.tiers import simulate

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
# Allowed height of gel above the indenter's lower side, over the depth, where gel is inside it:
# above this, the indenter has passed through the gel.
THROUGH = 0.7
# Required fraction of the lower bound: a corner of the gel yields up to four times as easily as its
# middle, and large strain softens it further.
LOWER = 0.2
# Allowed multiple of the upper bound: large strain stiffens, friction adds a third.
UPPER = 3.0
# Force over that of the spectral layer, which is linear: the error of default meshes is 5 to 25 %
# where contact is a few elements wide, that of linearity 10 % at large strain.
LAYER_LEAST, LAYER_MOST = 0.5, 1.8
# Depths, in thicknesses, at which a layer of small strain is a reliable reference.
LAYER_DEPTH = 0.02, 0.15
# Force across a mirror plane over the largest, or the stated error, if larger: without friction the
# error of default meshes, with friction points that slip early or late affect others.
ACROSS, ACROSS_RUBBING = 0.02, 0.05

AMOUNTS = r"near-layer|rises|same-place|closed-loop|coulomb|symmetric|no-overlap"
# Words of a warning, and the laws that it covers: a warning that the force depends on the mesh does
# not cover an indenter that passes through the gel, or a missing force.
COVERS: tuple[tuple[str, str], ...] = (
    (r"edge radius .* below the element", AMOUNTS),
    (r"inside the indenter|overlaps the", r"no-overlap|no-crossing|not-through"),
    (r"overlaps the side wall", rf"{AMOUNTS}|touches|within-bounds"),
    (r"below the base plane", r"above-base"),
    (r"may buckle", rf"{AMOUNTS}|within-bounds"),
    # Elements that a round rim cuts through may bear what is just beside the rim.
    (r"reaches the rim of the round body", rf"{AMOUNTS}|touches|lets-go|within-bounds"),
    (r"its own image in the plane", r"symmetric"),
)


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
        self.tips = self.scene.motion.tip
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
        x, y, z = np.transpose(self.tips)
        above = np.logical_and.accumulate(np.hypot(x - x[0], y - y[0]) < 1e-12)
        before = np.maximum.accumulate(np.append(0.0, -z[:-1]))
        return [int(frame) for frame in np.flatnonzero(above & (-z > before))]

    @cached_property
    def bounded(self) -> list[tuple[float, float, float]]:
        """Push of loading frames, its lower bound (0 for a first touch), and its upper bound."""
        least = max(TOUCH[0], TOUCH[1] * self.scene.body.thickness)
        rows = []
        for frame in self.loading if self.pressed else ():
            at = self.scene, self.tips[frame]
            lower = least_force(*at) if footprint(*at).deepest > least else 0.0
            rows.append((float(self.push[frame]), lower, most_force(*at)))
        return rows

    @cached_property
    def overlaps(self) -> list[tuple[float, float]]:
        """`overlap` of each frame."""
        return [geometry.overlap(self.result, frame) for frame in range(len(self.tips))]


# Bounds of a force from geometry and mechanics: outside, it is far wrong.


def least_force(scene: Scene, tip: Point) -> float:
    """Return a lower bound of the push of a frictionless press into an elastic gel [N].

    A flat disc that fits into the indenter at some depth presses less than the indenter, and the
    half-space under it is softer than a layer on a rigid base: 2 E* a d. In series with it is the
    whole gel as a column, so that a slim gel may yield as such.
    """
    raster, body = footprint(scene, tip), scene.body
    stiffness = body.modulus / (1 - body.poisson**2)
    area = body.size_x * body.size_y * (1.0 if body.footprint == "rectangle" else math.pi / 4)
    column = body.thickness / (body.modulus * area)
    steps = [axis[1] - axis[0] for axis in raster.axes]
    best = 0.0
    for fraction in (0.25, 0.5, 0.67, 0.85, 0.98) if raster.deepest > 0 else ():
        depth = fraction * raster.deepest
        within = np.pad(raster.deep >= depth, 1)
        radius = distance_transform_edt(within, sampling=steps).max() - max(steps)
        if radius > 0:
            best = max(best, depth / (1 / (2 * stiffness * radius) + column))
    return best


def most_force(scene: Scene, tip: Point) -> float:
    """Return an upper bound of the push of a frictionless press into an elastic gel [N].

    A disc around the whole contact presses more. Its force on a bonded layer is that on the
    half-space plus that of squeezing, the lesser of confined columns and of an incompressible sheet
    that flows sideways. The layer that is squeezed has the remaining thickness.
    """
    raster, body = footprint(scene, tip), scene.body
    radius = math.hypot(*(high - low for low, high in raster.box)) / 2
    left = max(body.thickness - raster.deepest, 0.05 * body.thickness)
    shear, stretch = body.shear_modulus, 2 * body.modulus / (1 - body.poisson**2)
    confined = (body.bulk_modulus + 4 / 3 * shear) * math.pi * radius**2 / left
    flowing = 1.5 * math.pi * shear * radius**4 / left**3
    half_space = stretch * radius * (body.thickness / left) ** 2
    stiffness = half_space + min(confined, flowing + stretch * radius**2 / left)
    return max(raster.deepest, 0.0) * stiffness


def layer_force(scene: Scene, tip: Point) -> float | None:
    """Return the push on the spectral layer at this place [N]; None where it is not reliable."""
    body = scene.body
    shallow = LAYER_DEPTH[0] <= -tip[2] / body.thickness <= LAYER_DEPTH[1]
    flat = body.dome_radius is None
    if not (flat and shallow and inside_by(scene, tip, 0.75 * body.thickness)):
        return None
    try:
        result = simulate(Scene(scene.indenter, Motion((tip,), (0.0,)), body), Layer())
    except (SceneError, SimulationDiverged):
        return None
    return -float(result.force[-1, 2])


# Laws of one result, each of one or more frames.


def _above_base(it: Reading) -> Laws:
    """The skin stays above the base plane to which the gel is bonded."""
    body, result = it.scene.body, it.result
    rest = body.heights(result.surface_x, result.surface_y)
    least = (rest + result.surface[..., 2]).min() / body.thickness
    yield at_least("lowest place of the skin / thickness", least, -1.0 - BELOW)


def _no_pull(it: Reading) -> Laws:
    """Contact does not pull, except slightly on a bar whose upper side is closed over by gel."""
    limit = PULL if it.smooth else 2 * PULL
    yield at_least("least push / largest force", it.push.min() / it.largest, -limit)


def _lets_go(it: Reading) -> Laws:
    """There is no force if the indenter is clear of the undeformed gel."""
    clear = 0.0 if it.elastic and it.smooth else -0.05 * it.scene.body.thickness
    if it.scene.indenter.solid is not None:
        clear -= OF_GRID * it.scene.indenter.solid.spacing
    for size, tip in zip(it.size, it.tips, strict=True):
        if it.pressed and footprint(it.scene, tip).deepest <= clear:
            yield at_most("force where nothing touches / largest", size / it.largest, NOTHING)


def _touches(it: Reading) -> Laws:
    """There is a force if the indenter overlaps the undeformed gel."""
    for push, lower, _ in it.bounded:
        if lower > it.nothing:
            yield at_least("push where gel is overlapped / none", push / it.nothing, 1.0)


def _within_bounds(it: Reading) -> Laws:
    """The push lies between the forces of discs inscribed in and around the indenter."""
    viscosity = it.scene.effects.viscosity
    stiffer = 1.0 + (sum(viscosity.ratios) if viscosity else 0.0)
    for push, lower, upper in it.bounded:
        if lower > it.nothing:
            yield at_least("push / lower bound", push / lower, LOWER)
        if upper > it.nothing:
            yield at_most("push / upper bound", push / (upper * stiffer), UPPER)


def _near_layer(it: Reading) -> Laws:
    """A shallow press away from the rim has the force of the spectral layer."""
    for frame in reversed(it.loading if it.elastic and it.weightless else []):
        layer = layer_force(it.scene, it.tips[frame])
        if layer is not None and layer > it.nothing:
            yield at_least("push / layer's", it.push[frame] / layer, LAYER_LEAST)
            yield at_most("push / layer's, at most", it.push[frame] / layer, LAYER_MOST)
            return


def _rises(it: Reading) -> Laws:
    """A deeper press has a larger force: elastic, no friction, away from the rim, up to a third."""
    thickness = it.scene.body.thickness
    some = [
        frame
        for frame in it.loading
        if -it.tips[frame][2] <= thickness / 3
        and inside_by(it.scene, it.tips[frame], 0.5 * thickness)
    ]
    for one, deeper in pairwise(some if it.elastic and it.smooth and it.weightless else []):
        rise, error = it.push[deeper] - it.push[one], it.stated[one] + it.stated[deeper]
        top = max(np.abs(it.push[some]).max(), it.nothing)
        yield at_least("least rise with depth / largest", rise / top, -max(DROP, error / top))


def _same_place(it: Reading) -> Laws:
    """Elastic, no friction: equal tip positions have equal forces, on any path."""
    frames = zip(it.tips, it.result.force, it.stated / it.largest, strict=True)
    for (tip, force, error), (place, other, its) in combinations(frames, 2):
        if it.elastic and it.smooth and tip == place:
            difference = float(np.linalg.norm(force - other)) / it.largest
            limit = max(SAME, float(error + its))
            yield at_most("difference at one place / largest force", difference, limit)


def _closed_loop(it: Reading) -> Laws:
    """A closed path returns no more work than it took; an elastic one returns all of it."""
    tips = it.tips
    loops = [end for end in range(3, len(tips) + 1) if tips[:end] == tips[end - 1 :: -1]]
    way = tips[: loops[-1]] if loops else ()
    if len(set(way)) > 1 and it.scene.effects.inertia is None:
        force = it.result.force[: len(way)]
        works = cumulative_trapezoid(force, np.array(way), axis=0).sum(axis=1)
        fraction = works[-1] / max(works.max(), it.nothing * it.scene.body.thickness)
        limit = RING[0] if it.smooth else RING[1]
        yield at_least("work in a closed loop / most", fraction, -limit)
        if it.elastic and it.smooth:
            yield at_most("work in an elastic loop / most", fraction, limit)


def _coulomb(it: Reading) -> Laws:
    """Nodal forces, resolved along the indenter's normals, obey Coulomb's law and do not pull.

    Only where the mesh resolves it: a contact of many nodes without narrow or sharp parts.
    """
    scene, result = it.scene, it.result
    friction = scene.effects.friction
    coefficient = friction.coefficient if friction else 0.0
    element = max(np.diff(result.surface_x).min(), np.diff(result.surface_y).min())
    radius = scene.indenter.sharpest
    if half_wall(scene) < 2 * element or radius < element:
        return
    limit = math.hypot(max(SHEAR, EDGE * element / radius), coefficient)
    for frame, tip in enumerate(it.tips):
        force = result.traction[frame].astype(float) * it.areas[..., None]
        loaded = np.linalg.norm(force, axis=-1)
        many = (loaded > 0.2 * loaded.max()).sum() >= NODES
        if not many or it.size[frame] <= max(0.05 * it.largest, it.nothing):
            continue
        _, normal = scene.indenter.distance(geometry.deformed(result, frame) - tip)
        pressure = (force * normal).sum(axis=-1)
        total = pressure.sum()
        # The rest is on the sides, which are not in the result.
        if total > 0.8 * it.size[frame] / math.hypot(1.0, coefficient):
            shear = np.linalg.norm(force - pressure[..., None] * normal, axis=-1).sum()
            tension = -np.minimum(pressure, 0.0).sum()
            yield at_most("sum of shear / sum of pressure", shear / total, limit)
            yield at_most("sum of tension / sum of pressure", tension / total, TENSION)


def _sums_up(it: Reading) -> Laws:
    """Tractions on the top add up to the force if the whole contact is on the top."""
    body = it.scene.body
    totals = np.einsum("fijk,ij->fk", it.result.traction.astype(float), it.areas)
    gaps = np.linalg.norm(totals - it.result.force, axis=1)
    for gap, size, tip in zip(gaps, it.size, it.tips, strict=True):
        heavy = body.dome_radius is None and size >= max(0.02 * it.largest, it.nothing)
        if heavy and inside_by(it.scene, tip, 0.5 * body.thickness):
            yield at_most("|sum of tractions - force| / force", gap / size, SUM)


def _through_centre(it: Reading) -> Laws:
    """Without friction, the force on a sphere passes through its centre."""
    indenter = it.scene.indenter
    sphere = indenter.name in ("sphere", "sphere_s") and indenter == indenter.upright
    if it.smooth and sphere:
        radius = indenter.sharpest
        expected = np.cross([0.0, 0.0, radius], it.result.force)
        gap = np.linalg.norm(it.result.wrench[:, 3:] - expected, axis=1).max()
        yield at_most("torque about the centre / force radius", gap / (radius * it.largest), LEVER)


def _symmetric(it: Reading) -> Laws:
    """A mirror-symmetric scene has no force across its plane."""
    limit = ACROSS if it.smooth else ACROSS_RUBBING
    for name in planes_of(it.scene):
        across = np.abs(it.result.force[:, :2] @ PLANES[name]) / it.largest
        beyond = across - np.maximum(limit, it.stated / it.largest)
        yield at_most("force across a mirror plane beyond its limit", beyond.max(), 0.0)


def _no_overlap(it: Reading) -> Laws:
    """The deformed top is not inside the indenter."""
    for frame, (deep, _) in enumerate(it.overlaps):
        limit = geometry.allowed(it.result, frame)
        yield at_most("overlap / what a mesh may leave", deep / limit, 1.0)


def _not_through(it: Reading) -> Laws:
    """The gel is not above the indenter's lower side, as after a wall has passed through it."""
    for (_, above), (_, _, z) in zip(it.overlaps, it.tips, strict=True):
        if z < -3 * geometry.SMALL:
            yield at_most("gel above the lower side / depth", above / -z, THROUGH)


def _no_crossing(it: Reading) -> Laws:
    """No skin passes through a wall from one side to the other between frames."""
    limit = half_wall(it.scene)
    for frame in range(1, len(it.tips) if math.isfinite(limit) else 0):
        way = geometry.crossed(it.result, frame) / limit
        yield at_most("way through a wall / half of it", way, geometry.OF_WALL)


_FUNCTIONS = (
    _above_base, _no_pull, _lets_go, _touches, _within_bounds, _near_layer, _rises, _same_place,
    _closed_loop, _coulomb, _sums_up, _through_centre, _symmetric, _no_overlap, _not_through, _no_crossing,
)  # fmt: skip
LAWS: dict[str, Callable[[Reading], Laws]] = {
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


def silent_laws(result: Result) -> list[str]:
    """Return the laws that a result breaks and that no warning of its own covers, with numbers."""
    warnings = result.record.get("warnings", [])
    broken = [(name, law) for name, law in measured(result) if not law.holds]
    return [f"{name}: {law}" for name, law in broken if not covered(name, warnings)]


def covered(law: str, warnings: Sequence[str]) -> bool:
    """Return True if any warning covers a violation of this law."""
    return any(
        re.search(words, warning) and re.fullmatch(laws, law)
        for warning in warnings
        for words, laws in COVERS
    )
