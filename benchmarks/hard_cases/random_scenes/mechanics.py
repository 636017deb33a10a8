"""Laws of mechanics, measured on a result without using the solver.

`Result.quality` is not used. Laws that compare forces hold within the error that the result states;
the bound from mechanics is wide enough for it already.
A law that does not apply to a scene (for example a closed loop, or a static force with inertia) is
skipped.
"""

import math
import re
from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.ndimage import distance_transform_edt

from benchmarks.hard_cases.laws import Array, Law, Laws, at_least, at_most
from benchmarks.hard_cases.random_scenes import geometry
from benchmarks.hard_cases.random_scenes.geometry import footprint, half_wall, inside_by
from sim.error_estimate import PLANES, planes_of
from sim.result import Result, force_scale
from sim.scene import Point, Scene

# Negligible force, in modulus times thickness squared: 0.2 uN in the paper's gel.
FLOOR = 1e-7
# Overlap with the undeformed gel above which a force is required [m], and in thicknesses.
TOUCH = 1e-6, 2.5e-4
# Negligible fraction of the largest force.
NOTHING = 1e-3
# Accuracy of a solid's surface, in spacings of its grid.
OF_GRID = 0.02
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
# Sum of tractions relative to the force.
SUM = 0.02
# Maximum depth of the skin below the base plane, in thicknesses.
BELOW = 1e-3
# Allowed height of gel above the indenter's lower side, over the depth, where gel is inside it:
# above this, the indenter has passed through the gel.
THROUGH = 0.7
# Required fraction of the lower bound: a corner of the gel yields up to four times as easily as its
# middle, and large strain softens it further.
LOWER = 0.2
# Force across a mirror plane over the largest, or the stated error, if larger: without friction the
# error of default meshes, with friction points that slip early or late affect others.
ACROSS, ACROSS_RUBBING = 0.02, 0.05

AMOUNTS = "closed-loop|coulomb|symmetric|no-overlap"
# Words of a warning, and the laws that it covers: a warning that the force depends on the mesh does
# not cover an indenter that passes through the gel, or a missing force.
COVERS: tuple[tuple[str, str], ...] = (
    (r"edge radius .* below the element", AMOUNTS),
    (r"inside the indenter|overlaps the", r"no-overlap|not-through"),
    (r"overlaps the side wall", f"{AMOUNTS}|touches"),
    (r"below the base plane", r"above-base"),
    (r"may buckle", AMOUNTS),
    # Elements that a round rim cuts through may bear an indenter just beside the rim.
    (r"reaches the rim of the round body", f"{AMOUNTS}|touches|lets-go"),
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
    def bounded(self) -> list[tuple[float, float]]:
        """Push of loading frames, and its lower bound (0 for a first touch)."""
        least = max(TOUCH[0], TOUCH[1] * self.scene.body.thickness)
        rows = []
        for frame in self.loading if self.pressed else ():
            at = self.scene, self.tips[frame]
            lower = least_force(*at) if footprint(*at).deepest > least else 0.0
            rows.append((float(self.push[frame]), lower))
        return rows

    @cached_property
    def overlaps(self) -> list[tuple[float, float]]:
        """`overlap` of each frame."""
        return [geometry.overlap(self.result, frame) for frame in range(len(self.tips))]


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
    """If the indenter overlaps the undeformed gel, the push is that of a disc inscribed in it."""
    for push, lower in it.bounded:
        if lower > it.nothing:
            yield at_least("push / lower bound", push / lower, LOWER)


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


_FUNCTIONS = (
    _above_base, _no_pull, _lets_go, _touches, _closed_loop, _coulomb, _sums_up, _symmetric,
    _no_overlap, _not_through,
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
