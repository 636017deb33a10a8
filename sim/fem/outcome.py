"""Outcome of one press: frames as they are read from the device, their result, and the verdict.

The verdict is an error for an overlap or a lost contact that is too large, warnings for less, and
the smaller elements that the result requires.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import KDTree

from sim.arrays import Array
from sim.errors import PassesThrough, SimulationDiverged
from sim.fem import Fem
from sim.fem.assembly import damping_time
from sim.fem.balance import READ
from sim.fem.mesh import Mesh
from sim.fem.sizing import (
    NOTHING,
    Sizes,
    coarser_than_required,
    covered,
    finer_at,
    resolved,
    sizes_of,
)
from sim.result import SIDES, WEAK, Outcome, Quality, Result, touched_by, width_of
from sim.scene import Body, Scene, beginning_of

# A round body on a grid: values at nodes outside it, and contact at its side wall.


class Round:
    """Side wall of a round body, which cuts through elements and is no contact face."""

    def __init__(self, scene: Scene, mesh: Mesh) -> None:
        self._scene, self._mesh = scene, mesh
        unit, body = scene.body.thickness, scene.body
        beside = mesh.beside
        columns = np.stack(np.meshgrid(mesh.x, mesh.y, indexing="ij"), axis=-1)
        self._nearest = KDTree(columns[~beside]).query(columns)[1]
        """Index of the body's nearest column of nodes, for each column (X, Y)."""
        self._of_body = np.flatnonzero(~beside)
        fraction = np.asarray(mesh.fraction)
        self._cut = ((fraction > 0) & (fraction < 1)).ravel()
        angle = np.linspace(0.0, 2 * np.pi, AROUND, endpoint=False)
        self._wall = np.stack([np.cos(angle), np.sin(angle)], axis=1) / (2 * unit)
        self._wall *= body.size_x, body.size_y
        low, high = np.array([mesh.x[[0, -1]], mesh.y[[0, -1]]]).T
        self._wall = np.clip(self._wall, low, high)  # rounding may put them outside
        rim = np.array([body.height(*point) for point in self._wall * unit]) / unit
        fraction = 1.0 + mesh.nodes[mesh.top[0, 0] - mesh.cells[2] : mesh.top[0, 0] + 1, 2]
        self._levels = -1.0 + (1.0 + rim)[:, None] * (fraction / fraction[-1])

    def continued(self, u: Array) -> Array:
        """Return displacements (N, 3) by column (X, Y, Z, 3), extended beyond the body's edge.

        Nodes without material have no displacement; a curve through zeros there would bend on the
        gel.
        """
        columns = u.reshape(self._nearest.size, -1, 3)
        every = columns[self._of_body[self._nearest]]
        return np.asarray(every.reshape(*self._nearest.shape, -1, 3))

    def touched(self, faces: NDArray[np.int64]) -> bool:
        """True if a touched face of the top (T,) is in a column that the side cuts through."""
        return bool(self._cut[faces[faces < len(self._cut)]].any())

    def wall(self, columns: Array) -> Array:
        """Return points (W, Z, 3) of the side wall, displaced by `continued` (X, Y, Z, 3)."""
        look = RegularGridInterpolator((self._mesh.x, self._mesh.y), columns)
        moved = np.asarray(look(self._wall))
        moved[..., :2] += self._wall[:, None]
        moved[..., 2] += self._levels
        return moved

    def overlapped(self, wall: Array, tip: Array) -> float:
        """Return the overlap of the side wall (W, Z, 3), over that of a top that did not give way.

        Both are volumes inside the indenter, the result at most 1. The wall's upper edge is the
        top's.
        """
        mesh, unit = self._mesh, self._scene.body.thickness

        def inside(points: Array) -> Array:
            outside = self._scene.indenter.distance((points - tip) * unit)[0]
            return np.where(outside < 0, -outside, 0.0)

        along = np.linalg.norm(np.diff(self._wall, axis=0, append=self._wall[:1]), axis=1)
        wide = along[:, None] * np.diff(self._levels, axis=1)
        beside = float((inside(wall[:, :-1]) * wide).sum())
        area = np.where(mesh.beside, 0.0, mesh.top_area)
        on_top = float((inside(mesh.nodes[mesh.top]) * area).sum())
        return beside / max(beside, on_top, 1e-30)


# Points around a round side wall that are tested for overlap with the indenter.
AROUND = 256


# Frames of one press.


@dataclass(slots=True)
class Spent:
    """Cost of the steps to the next frame of one press."""

    newton: int = 0
    cg: int = 0
    steps: int = 0


HOST = np.dtype(
    [
        ("depth", float),
        ("residual", float),
        ("base", float, 3),
        ("det", float),
        ("min_force_scale", float),
        ("self_overlap", float),
        ("self_node", int),
        ("work", float),
        ("work_most", float),
        ("overlap_path", float),
        ("newton", int),
        ("cg", int),
        ("steps", int),
    ]
)
"""Values of a frame that the host has, beside `READ`, in units of thickness and modulus.

Depth of the tip, residual, force of the base on the body, least determinant, least force by which
residuals are divided, results of `self_overlap`; work since the first frame, and the most of it so
far; greatest overlap along the steps to the frame; numbers of Newton iterations, of CG iterations
and of steps.
"""


class FrameCollector:
    """Frames of one press, filled as they are reached; the result is in SI units."""

    def __init__(self, scene: Scene, mesh: Mesh) -> None:
        self._scene, self._mesh = scene, mesh
        frames, shape = len(scene.motion.tip), (len(mesh.x), len(mesh.y), 3)
        self._read, self._host = np.zeros(frames, READ), np.zeros(frames, HOST)
        self._surface = np.full((frames, *shape), np.nan, np.float32)
        self._traction = np.full((frames, *shape), np.nan, np.float32)
        self._width, self._resolved = np.zeros((2, frames))
        self._unmeasured: list[int] = []
        self._touched: NDArray[np.bool_] | None = None
        """Contact of the frame that was measured last (X, Y), with this resolution."""
        self._resolution = np.inf
        self._work = self._work_most = self._overlap_path = 0.0
        self._below_base = 0.0
        self.round = None if mesh.fraction is None else Round(scene, mesh)
        """Side wall of a round body."""
        self._at_side: dict[str, list[int]] = {"rim": [], "wall": []}
        self._wall_shares: list[float] = []

    def moved(self, work: float, overlap: Array) -> None:
        """Add the work [E T^3] of a step, and the overlap along it, see `Assembly.overlap` (4,)."""
        self._work += work
        self._work_most = max(self._work_most, self._work)
        self._overlap_path = max(self._overlap_path, float(overlap[0]))
        self._below_base = max(self._below_base, float(overlap[2]))

    def keep(
        self, frame: int, read: np.void, surface: Array, traction: Array, host: tuple[Any, ...]
    ) -> None:
        """Store the values read of a frame, `READ`, and of the nodes of its top.

        These have displacements (X, Y, 3) [m] and tractions (X, Y, 3) [Pa]. `host` has the values
        of `HOST` up to those of the steps to the frame, and its cost.
        """
        if not frame:
            self._work = self._work_most = 0.0
        steps = self._work, self._work_most, self._overlap_path
        spent = host[-1]
        self._read[frame], self._surface[frame], self._traction[frame] = read, surface, traction
        self._host[frame] = (*host[:-1], *steps, spent.newton, spent.cg, spent.steps)
        self._overlap_path = 0.0
        self._unmeasured.append(frame)

    def measure(self) -> None:
        """Measure the contacts of the frames stored since the last call: 1 ms each."""
        if not self._unmeasured:
            return
        mesh, body, unit = self._mesh, self._scene.body, self._scene.body.thickness
        x, y, top = mesh.x * unit, mesh.y * unit, mesh.topmost * unit
        for frame in self._unmeasured:
            traction = self._traction[frame]
            self._width[frame] = width_of((traction != 0).any(axis=-1), x, y)
            touched = touched_by(traction)
            if self._touched is None or (touched != self._touched).any():
                self._touched = touched
                self._resolution = float(resolved(touched[None], x, y, body=body, top=top)[0])
            self._resolved[frame] = self._resolution
        self._unmeasured.clear()

    def keep_round(self, frame: int, u: Array, touched: NDArray[np.int32], tip: Array) -> None:
        """Store what a frame of a round body has beside `keep`; nothing for other bodies.

        It has displacements (N, 3) [T], touched points of each face (S,) and a tip (3,) [T].
        """
        body = self.round
        if body is None:
            return
        columns = body.continued(u)
        self._surface[frame] = columns[:, :, -1] * self._scene.body.thickness
        if body.touched(np.flatnonzero(touched)):
            self._at_side["rim"].append(frame)
        wall = body.wall(columns)
        if overlap := body.overlapped(wall, tip):
            self._at_side["wall"].append(frame)
            self._wall_shares.append(float(f"{overlap:.4g}"))
        self._below_base = max(self._below_base, -1.0 - float(wall[..., 2].min()))

    def up_to(self, frames: int) -> Self:
        """Return the collector of the first `frames`, which must have been kept."""
        self.measure()
        some = copy(self)
        some._scene = beginning_of(self._scene, frames)
        for name in ("_read", "_host", "_surface", "_traction", "_width", "_resolved"):
            setattr(some, name, getattr(self, name)[:frames])
        return some

    def result(self, record: dict[str, Any], numerics: Fem) -> Result:
        """Return the result; every frame must have been kept.

        `record` has the values that all presses of the batch share.
        """
        self.measure()
        entries = self._entries()
        scene, mesh, unit = self._scene, self._mesh, self._scene.body.thickness
        read, host, push = self._read, self._host, scene.body.modulus * unit**2
        force, energy, most = read["force"], read["energy"], host["work_most"]
        external = force + read["body"]
        sizes = [np.linalg.norm(one, axis=1) for one in (force, external, external + host["base"])]
        scale = np.maximum(np.maximum(sizes[0], sizes[1]), host["min_force_scale"])
        lost = host["work"] - (energy - energy[0])
        slip = read["excess"] / np.maximum(read["pressure"], 1e-30)
        overlap = read["overlap"] * unit
        worked = np.maximum(sizes[0] * host["depth"], 2 * energy)
        x, y = mesh.x * unit, mesh.y * unit
        quality = Quality(
            residual=host["residual"].copy(),
            contact=read["sunk"] / np.maximum(worked, 1e-30),
            balance=sizes[2] / scale,
            energy_gap=np.where(most > 1e-9, lost / np.maximum(most, 1e-9), 0.0),
            det_f_min=host["det"].copy(),
            slip_excess=np.full(len(slip), np.nan) if scene.effects.friction is None else slip,
            overlap=overlap[:, 0].copy(),
            overlap_bound=overlap[:, 1].copy(),
            overlap_path=np.maximum(host["overlap_path"] * unit, overlap[:, 0]),
            contact_width=self._width.copy(),
            **{name: host[name].copy() for name in ("newton", "cg", "steps")},
        )
        return Result(
            scene=scene,
            tier="fem",
            wrench=np.concatenate([force * push, read["torque"] * push * unit], axis=1),
            surface_x=x,
            surface_y=y,
            surface=self._surface,
            traction=self._traction,
            quality=quality,
            record={
                **record,
                "mesh": self._mesh_entry(record["mesh"]),
                **entries,
                "warnings": self._warnings(numerics, entries),
            },
        )

    def _entries(self) -> dict[str, Any]:
        """Return the entries of the record that come from the frames, [m].

        `overlap` has the material point that was deepest inside the indenter, and the largest depth
        below the base plane; `self_overlap` the depth of the skin inside itself in each frame, and
        the deepest point; `rim` and `wall` the waypoints at which those of a round body are
        touched, and `wall_shares` the wall's overlap, over the top's, at the latter.
        """
        mesh, unit = self._mesh, self._scene.body.thickness
        face = int(self._read["face"][np.argmax(self._read["overlap"][:, 0])])
        point = mesh.nodes[mesh.faces[face]].mean(axis=0) * unit
        inside = self._host["self_overlap"] * unit
        own: dict[str, Any] = {"metres": [float(f"{one:.4g}") for one in inside]}
        if inside.any():
            node = int(self._host["self_node"][np.argmax(inside)])
            own["place"] = [float(one) for one in mesh.nodes[node] * unit]
        return {
            "overlap": {
                "place": [float(one) for one in point],
                "below_base": self._below_base * unit,
            },
            "self_overlap": own,
            **{name: frames for name, frames in self._at_side.items() if frames},
            **({"wall_shares": self._wall_shares} if self._wall_shares else {}),
        }

    def _mesh_entry(self, shared: dict[str, Any]) -> dict[str, Any]:
        """Return the entry `mesh` of the record: what all meshes of the batch share, and its own.

        `resolved` is the contact resolution of each frame, 1 for 12 elements; None without contact.
        `damped` is the time of damping with inertia [s].
        """
        mesh, unit = self._mesh, self._scene.body.thickness
        entry = {
            **shared,
            "finest": mesh.finest * unit,
            "topmost": mesh.topmost * unit,
            "resolved": [float(one) if np.isfinite(one) else None for one in self._resolved],
        }
        damped = damping_time(self._scene, mesh)
        if damped:
            entry["damped"] = damped
        if np.isfinite(mesh.fineness):
            entry["fineness"] = round(mesh.fineness, 4)
        return entry

    def _warnings(self, numerics: Fem, entries: dict[str, Any]) -> list[str]:
        """Return warnings about errors of this result, with its frames' `entries` of the record."""
        scene, mesh, fineness = self._scene, self._mesh, numerics.fineness
        radius = scene.indenter.sharpest
        element = mesh.finest * scene.body.thickness
        reported = []
        if mesh.fineness < 0.99 * fineness:  # NaN, of other meshes, is not
            reported.append(
                f"the contact is meshed with a fineness of {mesh.fineness:.2g}, not the requested "
                f"{fineness:g}, which needs more than {numerics.elements_max} elements"
            )
        if radius < 0.99 * element:
            reported.append(
                f"edge radius {radius * 1e3:.3g} mm is below the element's {element * 1e3:.3g} mm: "
                "the force depends on the mesh and on the path; allowed without this warning: a "
                "finer mesh or a rounder edge"
            )
        sides = ((SIDES[name], frames) for name, frames in entries.items() if name in SIDES)
        reported += [f"{what}, at waypoints {frames}" for what, frames in sides]
        return reported


# Verdict on a result: overlaps and lost contacts that end it, and its warnings.

# Overlap of skin and indenter over the width of the contact: above the first the mesh is refined
# there, or a warning is issued; above the second there is no result. The second also holds for skin
# inside itself, after every step.
OVERLAP_GOOD, OVERLAP_MOST = 0.04, 0.2
# Overlap over the side of the smallest elements below which nothing has passed through: such an
# overlap is a light touch on elements that are far too large for it.
PASSED = 0.1
# Width of the undeformed body inside the indenter, over the side of the smallest elements, above
# which a contact has a force.
FELT = 2.0
# Distance from where a tip was last felt, over its depth there, within which it comes down at the
# same place.
ASIDE_MOST = 0.01
# Columns along x and y in which the indenter is looked for below the undeformed top.
COLUMNS_MOST = 65
PASSES = (
    "the indenter passes through the skin: {}; the mesh does not resolve the contact (allowed: "
    "finer elements, a rounder edge)"
)
# Energy that a body holds beyond the work of the indenter, over the most work so far, up to which
# there is no warning. The work is integrated over steps, to 1 % without friction. Of 21 random
# scenes 20 had 0.4 % or less and one 2.5 %; a leap over a ball had 14 %.
CREATED = 0.05
# Depth of the skin below the base plane, over the thickness, up to which there is no warning.
BELOW_GOOD = 0.01


# Radius of an edge over the depth below which skin that slides over it may have no smooth state: of
# 26 random scenes without an answer 21 have such an edge (docs/results/accuracy.md).
SHARP = 0.3


def advice(scene: Scene) -> str:
    """Return what would help a press that has no solution, if its edges are the likely reason."""
    sharpest, depth = scene.indenter.sharpest, scene.motion.depth_max
    if sharpest >= SHARP * depth:
        return ""
    return (
        f"skin leaves or folds at an edge of {sharpest * 1e3:.3g} mm, sharp for a depth of "
        f"{depth * 1e3:.3g} mm (allowed: a rounder edge, a shallower press); "
    )


class Passage(NamedTuple):
    """A way for something to pass through the skin."""

    inside: str
    """The body that the skin is inside of."""
    words: str
    """The reason if a path ends there, with a field for where."""
    brief: str
    """The same in a few words."""


FOLD = Passage(
    "the skin beside it",
    "the skin folds and passes through itself: {}; contact of the skin with itself is not computed "
    "(allowed: a shallower press, a shorter shear, a rounder edge)",
    "the skin overlaps itself",
)
LEAP = Passage(
    "the indenter on the way",
    "the skin leaps through the indenter: {} (allowed: shorter steps, a shallower press)",
    "the skin leaps through the indenter",
)


def checked(outcome: Outcome) -> Outcome:
    """Return the result with its warnings, or a failure if an overlap is too large."""
    if isinstance(outcome, SimulationDiverged):
        return outcome
    lost = _lost_contact(outcome)
    if lost is not None:
        deepest = 1e6 * float(outcome.quality.overlap_path.max())
        description = (
            f"no force at waypoint {lost}, inside the body; largest overlap with the skin before: "
            f"{deepest:.3g} um"
        )
        return PassesThrough(PASSES.format(description))
    warnings = list(outcome.record["warnings"])
    own = outcome.record["self_overlap"]
    through = outcome.quality.overlap, outcome.record["overlap"]["place"]
    folded = np.array(own["metres"]), own.get("place")
    for (overlap, point), inside, kind, words in (
        (through, "the indenter", PassesThrough, PASSES),
        (folded, FOLD.inside, SimulationDiverged, FOLD.words),
    ):
        fractions = overlap_shares(outcome, overlap)
        worst = int(np.argmax(fractions))
        if fractions[worst] <= OVERLAP_GOOD:
            continue
        deepest = float(overlap[worst])
        description = overlap_place(
            point, deepest, f"{inside} at waypoint {worst}", fractions[worst]
        )
        stated = "stiffening" in outcome.record  # it is in the error
        large = fractions[worst] > OVERLAP_MOST and not stated
        if large and deepest > PASSED * outcome.record["mesh"]["finest"]:
            return kind(words.format(description))
        warnings.append(description)
    straight, most = _straight_push(outcome), _buckling_load(outcome.scene.body)
    if straight > most:
        warnings.append(
            f"upright, this body would carry {straight:.3g} N, but it is so slender that "
            f"it may buckle above {most:.3g} N: other shapes are possible, with other forces"
        )
    created = -float(outcome.quality.energy_gap.min())
    if created > CREATED:
        warnings.append(
            f"the body holds {100 * created:.3g} % more energy than the indenter has given it: it "
            "leaps from one state to another, perhaps the wrong one (allowed: shorter steps)"
        )
    below = outcome.record["overlap"]["below_base"]
    if below > BELOW_GOOD * outcome.scene.body.thickness:
        warnings.append(
            f"the skin is {below * 1e3:.3g} mm below the base plane, next to the base: contact "
            "with it is not computed"
        )
    return replace(outcome, record={**outcome.record, "warnings": warnings})


def overlap_shares(result: Result, overlap: np.ndarray) -> np.ndarray:
    """Return overlaps (F,) over the contact's width, the depth if less, or the thickness."""
    tip = np.asarray(result.scene.motion.tip)
    return shares(overlap, result.quality.contact_width, tip, result.scene.body.thickness)


def shares(overlap: np.ndarray, width: np.ndarray, tip: np.ndarray, thickness: float) -> np.ndarray:
    """Return overlaps (F,) over the widths (F,), or over the depths of tips (F, 3) if less."""
    depth = np.maximum(-tip[:, 2], 0.0)
    scale = np.where(width > 0, np.minimum(width, np.maximum(depth, 0.1 * width)), depth)
    return overlap / np.where(scale > 1e-9 * thickness, scale, thickness)


def overlap_place(place: Sequence[float], deepest: float, inside: str, fraction: float) -> str:
    """Return which skin overlaps what, and how much, in words; lengths in [m]."""
    return (
        f"the skin that lay at ({1e3 * place[0]:.3g}, {1e3 * place[1]:.3g}) mm stands "
        f"{deepest * 1e6:.3g} um inside {inside}, {100 * fraction:.3g} % of the contact's width or "
        "depth"
    )


def _lost_contact(result: Result) -> int | None:
    """Return the first waypoint inside the body that has no normal force but should, if any.

    Either the indenter overlapped the skin before, or there it overlaps the undeformed body by more
    than points of contact are apart: something small may have passed between two states. A body
    that sags, swings or recovers slowly may be elsewhere: a tip that is lifted can leave it. It
    stays out until it comes down, and there too while it is above the height where it was last
    felt: the skin below can only have risen since.
    """
    scene, deepest = result.scene, 0.0
    effects = scene.effects
    at_rest = effects.viscosity is None and effects.inertia is None and effects.gravity is None
    finest = result.record["mesh"]["finest"]
    # A tip that has cut through the skin still pushes it aside.
    felt, lifted = result.force[:, 2] != 0, False
    tips = np.asarray(scene.motion.tip)
    left = tips[0]
    for waypoint, tip in enumerate(tips):
        deepest = max(deepest, float(result.quality.overlap_path[waypoint]))
        if felt[waypoint]:
            lifted, left = False, tip
            continue
        if waypoint and not at_rest:
            way = tip - tips[waypoint - 1]
            rises = way[2] > 0 and way[2] >= np.hypot(way[0], way[1])
            aside = np.hypot(*(tip - left)[:2])
            above = tip[2] > left[2] and aside < ASIDE_MOST * abs(left[2])
            lifted = lifted or (rises and bool(felt[waypoint - 1]))
            lifted = lifted and bool(way[2] >= 0 or above)
        if lifted or tip[2] >= 0:
            continue
        if deepest > PASSED * finest:
            if covered(scene.indenter, scene.body, tip) is not None:
                return waypoint
        elif at_rest and _overlapped_width(scene, tip) > FELT * finest:
            return waypoint
    return None


def _overlapped_width(scene: Scene, tip: np.ndarray) -> float:
    """Return the lesser width of the undeformed top that has the indenter below it [m]."""
    body, reach = scene.body, scene.body.thickness - float(tip[2])
    bounds = np.array(scene.indenter.bounds_below(reach)[:2]) + tip[:2, None]
    half = np.array([body.size_x, body.size_y]) / 2
    low, high = np.maximum(bounds[:, 0], -half), np.minimum(bounds[:, 1], half)
    if (low >= high).any():
        return 0.0
    x, y = (np.linspace(low[axis], high[axis], COLUMNS_MOST) for axis in (0, 1))
    lower = scene.indenter.heights(x[:, None] - tip[0], y - tip[1], reach=reach) + tip[2]
    below = (lower < body.heights(x, y)) & body.covers(x[:, None], y)
    if not below.any():
        return 0.0
    return float(min(np.ptp(x[below.any(axis=1)]), np.ptp(y[below.any(axis=0)])))


def _straight_push(result: Result) -> float:
    """Return the force of a punch as wide as the contact, in series with the body as a column [N].

    The force of the half-space is 2 a d E / (1 - nu^2). The width is that on the upright body: one
    that has buckled yields to the indenter, and touches it with an edge only.
    """
    scene, body = result.scene, result.scene.body

    def push(width: float) -> float:
        punch = width * body.modulus / (1 - body.poisson**2)
        column = body.modulus * body.size_x * body.size_y / body.thickness
        return float(scene.motion.depth_max / (1 / max(punch, 1e-30) + 1 / column))

    of_contact = push(float(result.quality.contact_width.max()))
    if push(min(body.size_x, body.size_y)) <= _buckling_load(body):
        return of_contact  # no contact is wide enough
    deepest = np.asarray(min(scene.motion.tip, key=lambda tip: tip[2]))
    return max(of_contact, push(_overlapped_width(scene, deepest)))


def _buckling_load(body: Body) -> float:
    """Return Euler's load of a column fixed at its base, its top free [N]: pi^2 E I / (4 T^2)."""
    short, long = sorted((body.size_x, body.size_y))
    return float(np.pi**2 * body.modulus * long * short**3 / 12 / (4 * body.thickness**2))


# Elements that a result requires.

# Element size over that required by the solution's own contact above which the mesh is rebuilt.
TOO_COARSE = 1.6


def coarseness(result: Result) -> float:
    """Return how much too coarse the solution finds its mesh; 1 or less is fine enough."""
    fineness = result.record["mesh"]["fineness"]
    ratio = coarser_than_required(required_by(result), result.surface_x, result.surface_y, fineness)
    overlap = overlap_shares(result, result.quality.overlap).max(initial=0.0)
    return max(ratio / TOO_COARSE, float(overlap) / OVERLAP_GOOD)


def more_wanted(result: Result) -> Sizes | None:
    """Return the element sizes that the solution requires beyond its mesh; None if fine enough."""
    fineness = result.record["mesh"]["fineness"]
    x, y = result.surface_x, result.surface_y
    required = required_by(result)
    wanted = wanted_of_overlap(result, OVERLAP_GOOD)
    if coarser_than_required(required, x, y, fineness) > TOO_COARSE:
        wanted = wanted.joined(required)
    return None if wanted is NOTHING else wanted


def wanted_of_overlap(result: Result, most: float) -> Sizes:
    """Return smaller elements where the overlap is largest, if its fraction is more than `most`."""
    if overlap_shares(result, result.quality.overlap).max(initial=0.0) <= most:
        return NOTHING
    fineness = result.record["mesh"]["fineness"]
    point = result.record["overlap"]["place"]
    return finer_at(point, result.surface_x, result.surface_y, fineness)


def required_by(result: Result) -> Sizes:
    """Return the element sizes required by the contacts of a solution."""
    x, y, thickness = result.surface_x, result.surface_y, result.scene.body.thickness
    force = np.linalg.norm(result.force, axis=1)
    required = Sizes((), (), np.inf)
    for frame in np.flatnonzero((force >= WEAK * force.max()) & (force > 0)).tolist():
        touched = touched_by(result.traction[frame])
        required = required.joined(sizes_of(touched, x, y, thickness))
    return required
