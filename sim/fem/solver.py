# mypy: ignore-errors
# Drives and reads Warp arrays, typed at run time; mypy cannot follow them.
"""Solver of the `fem` tier: all presses of a batch advance together, each along its own path."""

from __future__ import annotations

import json
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path as File
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from recorder.processes import cores
from recorder.progress import span_of
from sim.contact_size import touched_by, width_of
from sim.device import check_device
from sim.errors import PassesThrough, SimulationDiverged
from sim.fem.assembly import Assembly, is_split
from sim.fem.frames import Collector, Spent
from sim.fem.mesh import Mesh, meshes_of
from sim.fem.newton import NEARLY_CRUSHED, PATIENCE, ROUNDING, Newton, Path, path_of
from sim.fem.numerics import Fem, Precision
from sim.fem.overlap import COLUMNS
from sim.fem.self_overlap import self_overlap
from sim.fem.sizing import (
    NOTHING,
    Sizes,
    coarser_than_asked,
    covered,
    finer_at,
    sizes_of,
    stages_of,
)
from sim.indenters.device import traits_of
from sim.metrics import WEAK
from sim.result import SIDES, Outcome, Result, with_beginning
from sim.scene import Body, Motion, Scene

# Batches of a call, the precision of each, and the steps of one batch.

Progress = Callable[[float], None]
# Required element sizes, by index of the scene and the number of its waypoints they apply to.
Asked = dict[tuple[int, int], Sizes]

# Samples along a side of a face at which overlap is measured, for frames and for intermediate
# states; and the number of states per step, its end included.
FRAME_SAMPLES, PATH_SAMPLES, PATH_STATES = 8, 3, 3
# Times that `auto` halves a step to a waypoint in float32 before it goes on in float64. Most such
# steps are limited by rounding, where forces or elements are small, and each costs as much as ten
# steps that converge.
HALVINGS_FLOAT32 = 1
# Most elements per batch: those that fit a CPU's cache or a GPU's memory.
ELEMENTS_SIDE_BY_SIDE = {"cpu": 20_000, "cuda": 20_000_000}


def simulate_fem(
    scenes: Sequence[Scene],
    numerics: Fem = Fem(),
    *,
    device: str = "cpu",
    progress: Progress | None = None,
    asked: Asked | None = None,
) -> list[Outcome]:
    """Simulate presses and return the outcomes in their order: a result or the reason for none.

    Args:
        scenes: Scenes to simulate; those with the same thickness, mesh topology and set of effects
            are solved in one batch.
        numerics: Mesh, precision and tolerances.
        device: `cpu`, or `cuda:0` and the like.
        progress: Called with the fraction done, 0 to 1.
        asked: Element sizes that solutions of the same scenes on coarser meshes required; those
            required by these solutions are added. They save building a mesh that proves too coarse.

    Raises:
        SceneError: A mesh cannot be built, or the device does not exist.
    """
    check_device(device)
    if not numerics.follows:
        outcomes = _on_meshes(scenes, numerics, None, device, progress)
        return [judged(outcome) for outcome in outcomes]
    stages = [stages_of(scene) for scene in scenes]
    parts = [(i, stage) for i, each in enumerate(stages) for stage in each]
    some = [_beginning(scenes[i], stage.waypoints) for i, stage in parts]
    keys = [(i, stage.waypoints) for i, stage in parts]
    known = asked or {}
    sizes = [known.get(key, stage.sizes) for key, (_i, stage) in zip(keys, parts, strict=True)]
    outcomes, lasting = _following(some, sizes, numerics, device, progress)
    if asked is not None:
        for key, size, outcome in zip(keys, lasting, outcomes, strict=True):
            asked[key] = _learnt(size, outcome)
    of_scene: list[list[Outcome]] = [[] for _scene in scenes]
    for (i, _stage), outcome in zip(parts, outcomes, strict=True):
        of_scene[i].append(judged(outcome))
    return [_in_one(each) for each in of_scene]


def _beginning(scene: Scene, waypoints: int) -> Scene:
    """Return the scene with its first `waypoints` waypoints."""
    motion = scene.motion
    if waypoints == len(motion):
        return scene
    return replace(scene, motion=Motion(motion.tip[:waypoints], motion.time[:waypoints]))


def _in_one(stages: list[Outcome]) -> Outcome:
    """Return the result of all waypoints, its beginning replaced by solutions of later stages."""
    whole = stages[0]
    for stage in stages:
        if isinstance(stage, SimulationDiverged):
            return stage
    for stage in stages[1:]:
        whole = with_beginning(whole, stage)
    return whole


def _following(
    scenes: Sequence[Scene],
    sizes: Sequence[Sizes],
    numerics: Fem,
    device: str,
    progress: Progress | None,
) -> tuple[list[Outcome], list[Sizes]]:
    """Solve presses on meshes that follow their contacts, rebuilt where the solution needs more.

    Returns:
        The outcomes; `sizes`, and with them those required by overlaps so large that finer meshes
        will have them too.
    """
    sizes, lasting = list(sizes), list(sizes)
    outcomes = _on_meshes(scenes, numerics, sizes, device, progress)
    before = np.full(len(scenes), np.inf)
    for attempt in range(1, REMESHED + 1):
        wanted = {i: more_wanted(one) for i, one in enumerate(outcomes) if isinstance(one, Result)}
        if attempt == 1:
            crossed = {i: one for i, one in enumerate(outcomes) if isinstance(one, Crossed)}
            wanted |= {i: one.wanted for i, one in crossed.items()}
        again = []
        for i, more in wanted.items():
            if more is None or not refines(scenes[i], numerics, sizes[i], more, outcomes[i]):
                continue
            if isinstance(outcomes[i], Crossed):
                again.append(i)
                continue
            lacking = lacks(outcomes[i])
            useless = isinstance(judged(outcomes[i]), SimulationDiverged)
            if useless or lacking < LACKS_LESS * before[i]:
                again.append(i)
            before[i] = lacking
        if not again:
            break
        for i in again:
            sizes[i] = sizes[i].joined(wanted[i])
            if isinstance(outcomes[i], Result):
                lasting[i] = lasting[i].joined(_wanted_of_overlap(outcomes[i], OVERLAP_LASTS))
        alike: dict[Precision, list[int]] = {}
        for i in again:
            alike.setdefault(precision_for_finer(outcomes[i], numerics), []).append(i)
        for precision, chosen in alike.items():
            some = _on_meshes(
                [scenes[i] for i in chosen],
                replace(numerics, precision=precision),
                [sizes[i] for i in chosen],
                device,
                None,
            )
            for i, outcome in zip(chosen, some, strict=True):
                if isinstance(outcomes[i], Crossed):
                    outcomes[i].forget_dump()
                outcomes[i] = _remeshed(outcome, attempt, outcomes[i])
    return outcomes, lasting


class Crossed(SimulationDiverged):
    """No result, because the skin passes through itself or through the indenter.

    It has what `Result` has of the mesh, and `wanted`, the elements that may avoid it.
    """

    wanted: Sizes
    surface_x: np.ndarray
    """Positions of the nodes of the mesh (X,) [m]."""
    surface_y: np.ndarray
    """The same along y (Y,) [m]."""
    record: dict


def refines(
    scene: Scene, numerics: Fem, sizes: Sizes, more: Sizes, found: Result | Crossed
) -> bool:
    """True if a mesh with `more` sizes is finer there than that of the result.

    At the limit on elements all of them are enlarged, so that a rebuilt mesh may not be.
    """
    (mesh,) = meshes_of([scene], numerics, [sizes.joined(more)])
    unit = scene.body.thickness
    before = coarser_than_asked(more, found.surface_x, found.surface_y)
    return before > REFINED * coarser_than_asked(more, mesh.x * unit, mesh.y * unit)


def precision_for_finer(found: Result | Crossed, numerics: Fem) -> Precision:
    """Return the precision for a finer mesh: float64 if `auto` already had to fall back to it."""
    double = numerics.precision == "auto" and found.record["precision"] == "float64"
    return "float64" if double else numerics.precision


def _on_meshes(
    scenes: Sequence[Scene],
    numerics: Fem,
    sizes: Sequence[Sizes] | None,
    device: str,
    progress: Progress | None,
) -> list[Outcome]:
    """Solve presses on meshes of the given element sizes, or on those of the numerics."""
    began = time.perf_counter()
    meshes = meshes_of(scenes, numerics, sizes)
    meshed = (time.perf_counter() - began) / max(len(scenes), 1)
    outcomes: dict[int, Outcome] = {}
    for chosen in _batches(scenes, meshes, numerics, device):
        fraction = None
        if progress is not None:
            fraction = span_of(progress, len(outcomes), len(chosen), len(scenes))
        stiffer = replace(
            numerics, penalty=_penalty(scenes[chosen[0]], meshes[chosen[0]], numerics)
        )
        some = _solve(
            [scenes[i] for i in chosen],
            [meshes[i] for i in chosen],
            stiffer,
            device,
            meshed * len(chosen),
            fraction,
        )
        outcomes.update(zip(chosen, some, strict=True))
    return [outcomes[i] for i in range(len(scenes))]


# Checks whether a mesh was fine enough for its solution.

# Most times that a mesh is rebuilt because the solution shows that it was too coarse.
REMESHED = 2
# Least ratio by which elements of a rebuilt mesh are smaller where that is required: a mesh that is
# hardly finer is not worth its time.
REFINED = 1.2
# A mesh is rebuilt again if the last time multiplied what was lacking by less than this, or if the
# solution is of no use as it is.
LACKS_LESS = 0.9
# Element size over that required by the solution's own contact: above the first the mesh is
# rebuilt, above the second a finer mesh is built for that contact from the start.
TOO_COARSE, COARSE = 1.6, 1.25
# Overlap of skin and indenter over the width of the contact: above the first the mesh is refined
# there, or a warning is issued; above the second there is no result. The second also holds for skin
# inside itself, after every step.
OVERLAP_GOOD, OVERLAP_MOST = 0.04, 0.2
# Overlap over the width above which a mesh 1.6 times as fine is expected to have one that is too
# large as well: it falls with the square of the elements' size.
OVERLAP_LASTS = 0.1
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
# 26 random scenes without an answer 21 have such an edge (docs/results/tolerance.md).
SHARP = 0.3


def _advice(scene: Scene) -> str:
    """Return what would help a press that has no solution, if its edges are the likely reason."""
    sharpest, depth = scene.indenter.sharpest, scene.motion.depth_max
    if sharpest >= SHARP * depth:
        return ""
    return (
        f"skin leaves or folds at an edge of {sharpest * 1e3:.3g} mm, sharp for a depth of "
        f"{depth * 1e3:.3g} mm (allowed: a rounder edge, a shallower press); "
    )


class _Kind(NamedTuple):
    """A way for something to pass through the skin."""

    inside: str
    """The body that the skin is inside of."""
    words: str
    """The reason if a path ends there, with a field for where."""
    brief: str
    """The same in a few words."""


FOLD = _Kind(
    "the skin beside it",
    "the skin folds and passes through itself: {}; contact of the skin with itself is not computed "
    "(allowed: a shallower press, a shorter shear, a rounder edge)",
    "the skin overlaps itself",
)
LEAP = _Kind(
    "the indenter on the way",
    "the skin leaps through the indenter: {} (allowed: shorter steps, a shallower press)",
    "the skin leaps through the indenter",
)


def overlap_shares(result: Result, overlap: np.ndarray) -> np.ndarray:
    """Return the overlap of each frame (F,) over its contact's width, or over the depth if less.

    Frames without a press are divided by the thickness.
    """
    tip = np.asarray(result.scene.motion.tip)
    return _shares(overlap, result.quality.contact_width, tip, result.scene.body.thickness)


def _shares(
    overlap: np.ndarray, width: np.ndarray, tip: np.ndarray, thickness: float
) -> np.ndarray:
    """Return overlaps (F,) over the widths (F,), or over the depths of tips (F, 3) if less."""
    depth = np.maximum(-tip[:, 2], 0.0)
    scale = np.where(width > 0, np.minimum(width, np.maximum(depth, 0.1 * width)), depth)
    return overlap / np.where(scale > 1e-9 * thickness, scale, thickness)


def lacks(result: Result) -> float:
    """Return how much too coarse the solution finds its mesh; 1 or less is fine enough."""
    fineness = result.record["mesh"]["fineness"]
    ratio = coarser_than_asked(_asked_by(result), result.surface_x, result.surface_y, fineness)
    overlap = overlap_shares(result, result.quality.overlap).max(initial=0.0)
    return max(ratio / TOO_COARSE, float(overlap) / OVERLAP_GOOD)


def more_wanted(result: Result) -> Sizes | None:
    """Return the element sizes that the solution requires beyond its mesh; None if fine enough."""
    fineness = result.record["mesh"]["fineness"]
    x, y = result.surface_x, result.surface_y
    found = _asked_by(result)
    wanted = _wanted_of_overlap(result, OVERLAP_GOOD)
    if coarser_than_asked(found, x, y, fineness) > TOO_COARSE:
        wanted = wanted.joined(found)
    return None if wanted is NOTHING else wanted


def _wanted_of_overlap(result: Result, most: float) -> Sizes:
    """Return smaller elements where the overlap is largest, if its fraction is more than `most`."""
    if overlap_shares(result, result.quality.overlap).max(initial=0.0) <= most:
        return NOTHING
    fineness = result.record["mesh"]["fineness"]
    place = result.record["overlap"]["place"]
    return finer_at(place, result.surface_x, result.surface_y, fineness)


def _asked_by(result: Result) -> Sizes:
    """Return the element sizes required by the contacts of a solution."""
    x, y, thickness = result.surface_x, result.surface_y, result.scene.body.thickness
    force = np.linalg.norm(result.force, axis=1)
    found = Sizes((), (), np.inf)
    for frame in np.flatnonzero((force >= WEAK * force.max()) & (force > 0)).tolist():
        touched = touched_by(result.traction[frame])
        found = found.joined(sizes_of(touched, x, y, thickness))
    return found


def _learnt(sizes: Sizes, outcome: Outcome) -> Sizes:
    """Return the sizes for a finer mesh, with those of the solution's contacts where finer."""
    if isinstance(outcome, SimulationDiverged):
        return sizes
    mesh, found = outcome.record["mesh"], _asked_by(outcome)
    ratio = coarser_than_asked(found, outcome.surface_x, outcome.surface_y, mesh["fineness"])
    return sizes.joined(found) if "made_anew" in mesh or ratio > COARSE else sizes


def _remeshed(outcome: Outcome, times: int, before: Result | Crossed) -> Outcome:
    if isinstance(outcome, SimulationDiverged):
        return outcome
    record = {**outcome.record, "mesh": {**outcome.record["mesh"], "made_anew": times}}
    if record["precision"] == before.record["precision"] and "precision_reason" in before.record:
        record.setdefault("precision_reason", before.record["precision_reason"])
    return replace(outcome, record=record)


def judged(outcome: Outcome) -> Outcome:
    """Return the result with its warnings, or a failure if an overlap is too large."""
    if isinstance(outcome, SimulationDiverged):
        return outcome
    lost = _lost_contact(outcome)
    if lost is not None:
        deepest = 1e6 * float(outcome.quality.overlap_path.max())
        where = (
            f"no force at waypoint {lost}, inside the body; largest overlap with the skin before: "
            f"{deepest:.3g} um"
        )
        return PassesThrough(PASSES.format(where))
    warnings = list(outcome.record["warnings"])
    own = outcome.record["self_overlap"]
    through = outcome.quality.overlap, outcome.record["overlap"]["place"]
    folded = np.array(own["metres"]), own.get("place")
    for (overlap, place), inside, kind, words in (
        (through, "the indenter", PassesThrough, PASSES),
        (folded, FOLD.inside, SimulationDiverged, FOLD.words),
    ):
        fractions = overlap_shares(outcome, overlap)
        worst = int(np.argmax(fractions))
        if fractions[worst] <= OVERLAP_GOOD:
            continue
        deepest = float(overlap[worst])
        where = _where(place, deepest, f"{inside} at waypoint {worst}", fractions[worst])
        if fractions[worst] > OVERLAP_MOST and deepest > PASSED * outcome.record["mesh"]["finest"]:
            return kind(words.format(where))
        warnings.append(where)
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


def _where(place: Sequence[float], deepest: float, inside: str, fraction: float) -> str:
    return (
        f"the skin that lay at ({1e3 * place[0]:.3g}, {1e3 * place[1]:.3g}) mm stands "
        f"{deepest * 1e6:.3g} um inside {inside}, {100 * fraction:.3g} % of the contact's width or "
        "depth"
    )


def _lost_contact(result: Result) -> int | None:
    """Return the first waypoint inside the body that has no force but should, if any.

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
    felt, lifted = result.force.any(axis=1), False
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


# Elements per thickness up to which `Fem.penalty` applies unchanged. With smaller elements
# contact is stiffer by the same factor, in powers of 2, because small contacts reach the same
# pressure over smaller depths.
SOFT_SHARE = 24
# Instantaneous over relaxed stiffness of a viscous body above which contact is made stiffer: with a
# ratio of 100 the indenter stood 10 % of its depth inside the skin.
STIFF_AT_ONCE = 4.0


def _penalty(scene: Scene, mesh: Mesh, numerics: Fem) -> float:
    """Return the contact stiffness on a mesh [E / T]."""
    finer = max(1.0, 1.0 / (SOFT_SHARE * mesh.finest)) if numerics.follows else 1.0
    viscosity = scene.effects.viscosity
    at_once = 1.0 if viscosity is None else 1.0 + sum(viscosity.ratios)
    stiffer = max(1.0, at_once / STIFF_AT_ONCE)
    return float(numerics.penalty * 2.0 ** (np.round(np.log2(finer)) + np.round(np.log2(stiffer))))


def _batches(
    scenes: Sequence[Scene], meshes: Sequence[Mesh], numerics: Fem, device: str
) -> list[list[int]]:
    """Group scenes into batches of the same mesh topology and kernels, limited in size."""
    alike: dict[tuple, list[int]] = {}
    for index, (scene, mesh) in enumerate(zip(scenes, meshes, strict=True)):
        kernels = scene.effects.key, traits_of([scene.indenter]), is_split([scene])
        key = scene.body.thickness, mesh.cells, kernels, _penalty(scene, mesh, numerics)
        alike.setdefault(key, []).append(index)
    most = ELEMENTS_SIDE_BY_SIDE["cuda" if wp.get_device(device).is_cuda else "cpu"]
    batches = []
    for group in alike.values():
        size = max(1, most // len(meshes[group[0]].elements))
        batches += [group[i : i + size] for i in range(0, len(group), size)]
    return batches


def _solve(scenes, meshes, numerics, device, meshed, progress) -> list[Outcome]:
    """Solve one batch, in the requested precision or the one that it needs."""
    if numerics.precision != "auto":
        batch = _Batch(scenes, meshes, numerics, numerics.precision, device, meshed, progress)
        return batch.run()
    trial = replace(numerics, halvings=min(numerics.halvings, HALVINGS_FLOAT32))
    batch = _Batch(scenes, meshes, trial, "float32", device, meshed, progress)
    outcomes = batch.run()
    again = [i for i in range(len(outcomes)) if batch.may_go_on(i)]
    if again:
        reached = batch.reached(again)
        del batch  # frees its memory on the device
        retried = _Batch(
            [scenes[i] for i in again],
            [meshes[i] for i in again],
            numerics,
            "float64",
            device,
            meshed,
            progress,
            reached,
        ).run()
        for i, outcome in zip(again, retried, strict=True):
            outcomes[i].forget_dump()
            outcomes[i] = _with_reason(outcome, f"float32 did not converge: {outcomes[i]}")
    return outcomes


def _with_reason(outcome: Outcome, reason: str) -> Outcome:
    if isinstance(outcome, SimulationDiverged):
        return outcome
    return replace(outcome, record={**outcome.record, "precision_reason": reason})


# Further updates of the multipliers where an indenter has all but left the skin: they remember the
# press before, and each leaves a tenth of it or less. Below this fraction of the largest force.
FADED, FADED_BELOW = 3, 0.01


# Threads of the host that look at folded skins beside a GPU. Nearly half of their work holds the
# interpreter's lock, so that more threads wait for each other: two were 1.9 times as fast as one,
# six 1.5 times (two cores), and sixteen on sixteen cores slower than six.
THREADS = 3


def on_host(device: str, function: Callable[..., Any], *items: Iterable[Any]) -> list[Any]:
    """Return a function of the host for each of the items: in threads beside a GPU.

    A GPU's batch has many presses, and NumPy leaves the interpreter's lock to other threads.
    """
    if device == "cpu":
        return list(map(function, *items))
    with ThreadPoolExecutor(min(THREADS, cores())) as pool:
        return list(pool.map(function, *items))


@dataclass(frozen=True, slots=True)
class _Passed:
    """A step in which something has passed through the skin."""

    why: str
    """The reason, if the path ends there."""
    wanted: Sizes
    """Elements that may avoid it."""
    brief: str
    """The same in a few words."""


@dataclass(frozen=True, slots=True)
class _Reached:
    """State of some environments when their batch ends, from which another one goes on."""

    history: dict[str, np.ndarray]
    """Result of `SolverState.history`."""
    collectors: list[Collector]
    """Frames kept so far."""
    paths: list[Path]
    spent: list[Spent]
    seconds: float
    """Time of the batch."""


class _Batch:
    """Presses on meshes of one topology, each with a separate path and step.

    They begin at the first step, or where those of another batch have ended (`reached`).
    """

    def __init__(
        self, scenes, meshes, numerics, precision, device, meshed, progress, reached=None
    ) -> None:
        self._scenes, self._meshes, self._numerics = scenes, meshes, numerics
        self._progress = progress
        began = time.perf_counter()
        self._assembly = Assembly(meshes, scenes, numerics, precision, device)
        self._newton = Newton(self._assembly)
        self._collectors = list(map(Collector, scenes, meshes))
        self._unmeasured: deque[Collector] = deque()
        self._area = np.array([mesh.top_area for mesh in meshes])[..., None]
        self._stress = np.array([scene.body.modulus for scene in scenes])[:, None, None, None]
        self._paths: list[Path] = [
            path_of(scene, numerics, *([mesh.finest] if numerics.follows else []))
            for scene, mesh in zip(scenes, meshes, strict=True)
        ]
        self._seconds = {"mesh": meshed, "build": time.perf_counter() - began}
        self._failed: dict[int, SimulationDiverged] = {}
        count = len(scenes)
        self._spent = [Spent() for _scene in scenes]
        self._busy = np.zeros(count, bool)
        self._augmented = np.zeros(count, int)
        self._largest = np.zeros(count)  # force at a waypoint, by environment [E T^2]
        self._last = np.zeros((count, 2))
        self._deepest = np.zeros(count)  # overlap along the last accepted step [T]
        self._tip, self._share = np.zeros((count, 3)), np.zeros(count)
        self._duration, self._load = np.ones(count), np.ones(count)
        state = self._assembly.state
        state.start(np.array([path.corners[0] for path in self._paths]))
        self._before = 0.0
        if reached is not None:
            self._collectors, self._paths = reached.collectors, reached.paths
            self._spent, self._before = reached.spent, reached.seconds
            for path in self._paths:
                path.go_on(numerics.halvings)
            state.go_on(reached.history)

    def reached(self, chosen: list[int]) -> _Reached:
        """Return what the chosen environments have reached: their last accepted states."""
        return _Reached(
            history=self._assembly.state.history(chosen),
            collectors=[self._collectors[i] for i in chosen],
            paths=[self._paths[i] for i in chosen],
            spent=[self._spent[i] for i in chosen],
            seconds=self._seconds["solve"],
        )

    def may_go_on(self, env: int) -> bool:
        """True if an environment has failed where float64 may succeed."""
        return env in self._failed and not self._paths[env].ended

    def run(self) -> list[Outcome]:
        began = time.perf_counter()
        newton = self._newton
        while True:
            paths = enumerate(self._paths)
            open_ = np.array([not p.finished and i not in self._failed for i, p in paths])
            if not open_.any():
                break
            self._begin(open_ & ~self._busy)
            running = self._busy & ~newton.converged & ~newton.failed
            if running.any():
                newton.sweep(running, self._measure)
            self._finish(self._busy & (newton.converged | newton.failed))
        self._seconds["solve"] = self._before + time.perf_counter() - began
        record = self._record()

        def outcome(env: int) -> Outcome:
            failed = self._failed.get(env)
            return failed or self._collectors[env].result({**record, **self._of_one(env)})

        return [outcome(env) for env in range(len(self._scenes))]

    def _begin(self, idle: np.ndarray) -> None:
        """Begin the next step of the idle environments (B,)."""
        if not idle.any():
            return
        guess, tolerance, patience = np.zeros((3, len(idle)))
        for i in np.flatnonzero(idle).tolist():
            path = self._paths[i]
            self._share[i], self._tip[i], self._duration[i] = path.goal()
            self._load[i] = path.load(self._share[i])
            tolerance[i] = self._tolerance(self._share[i])
            patience[i] = path.patience(self._numerics.newton_max) if path.patient else 1.0
            segment, step = self._last[i]
            going_on = segment == path.segment and step > 0 and path.halvings == 0
            if going_on and "friction" in self._assembly.effects:
                guess[i] = min((self._share[i] - path.fraction) / step, 1.5)
        self._busy |= idle
        self._augmented[idle] = 0
        if "gravity" in self._assembly.effects:
            self._assembly.state.put_weight(self._load)
        self._assembly.state.begin_step(idle, self._tip, self._duration, guess)
        self._newton.begin(idle, tolerance, predict=guess == 0, patience=patience)

    def _tolerance(self, fraction: float) -> float:
        numerics = self._numerics
        loose = numerics.path_tolerance
        if loose is None:
            history = {"viscosity", "inertia"} & set(self._assembly.effects)
            loose = 1e-3 if history else 1e-2
        return numerics.tolerance if fraction >= 1.0 else max(loose, numerics.tolerance)

    def _finish(self, done: np.ndarray) -> None:
        """Accept the steps that have converged, halve those that have failed (B,)."""
        if not done.any():
            return
        assembly, newton = self._assembly, self._newton
        again, good, bad = np.zeros((3, len(done)), bool)
        force = np.linalg.norm(assembly.sums.contact, axis=1)
        at_goal = done & newton.converged & (self._share >= 1.0)
        self._largest[at_goal] = np.maximum(self._largest, force)[at_goal]
        for i in np.flatnonzero(done).tolist():
            spent = self._spent[i]
            spent.newton += int(newton.iterations[i])
            spent.cg += int(newton.cg[i])
            if self._augmented[i] or self._paths[i].patient:
                self._paths[i].patient_left -= max(0, int(newton.iterations[i]) - PATIENCE)
            if not newton.converged[i]:
                bad[i] = True
            elif at_goal[i] and self._augmented[i] < self._augmentations(force[i], i):
                again[i] = True
            else:
                good[i] = True
        if again.any():
            self._augmented[again] += 1
            assembly.state.update_multiplier(assembly.state.mask(again))
            most = self._numerics.newton_max
            newton.resume(again, np.array([path.patience(most) for path in self._paths]))
        way, folds, passed = self._look(good)
        for i in passed:
            good[i], bad[i] = False, True
        self._take(good, way, folds)
        if bad.any():
            assembly.state.rollback_step(assembly.state.mask(bad))
        for i in np.flatnonzero(bad).tolist():
            self._spent[i].steps += 1
            reported = (
                f"{newton.iterations[i]} Newton iterations, residual {newton.residual[i]:.2e}"
            )
            self._last[i] = -1
            crushed, through = bool(newton.crushed[i]), passed.get(i)
            why = ""
            if through is not None:
                why, reported = through.why, f"{reported}; {through.brief}"
            more = self._paths[i].refuse(self._share[i], reported, crushed=crushed, crossed=why)
            if not more or self._is_rounding(i):
                self._failed[i] = self._diverged(i, through)
        self._busy &= ~(good | bad)

    def _look(
        self, good: np.ndarray
    ) -> tuple[np.ndarray, dict[int, tuple[float, int]], dict[int, _Passed]]:
        """Measure the overlaps of completed steps (B,).

        Returns:
            Overlap along the steps (B, 4); results of `self_overlap`, by environment, of those that
            have folded; those in which something has passed through the skin.
        """
        assembly, folds, passed = self._assembly, {}, {}
        if not good.any():
            return np.zeros((len(good), COLUMNS)), folds, passed
        way = assembly.overlap(assembly.state.mask(good), samples=PATH_SAMPLES, states=PATH_STATES)
        folded = np.flatnonzero(good & (way[:, 3] > 0)).tolist()
        leapt = self._leapt(good, way[:, 0])
        some = sorted({*folded, *leapt})
        if not some:
            return way, folds, passed
        top = assembly.read(some, self._tip)[1]
        touched = dict(zip(some, top[..., 3:].any(axis=-1), strict=True))
        if folded:
            displaced = assembly.rows(assembly.state.u, folded).astype(float)
            meshes = [self._meshes[i] for i in folded]
            found = on_host(assembly.device, self_overlap, meshes, displaced)
            folds.update(zip(folded, found, strict=True))
        overlaps = [
            (i, deep, self._meshes[i].nodes[node], FOLD)
            for i, (deep, node) in folds.items()
            if deep > PASSED * assembly.finest[i]
        ]
        overlaps += [(i, float(way[i, 0]), place, LEAP) for i, place in leapt.items()]
        for i, deep, place, kind in overlaps:
            through = self._too_deep(i, deep, place, touched[i], kind)
            if through is not None:
                passed[i] = through
        return way, folds, passed

    def _leapt(self, good: np.ndarray, way: np.ndarray) -> dict[int, np.ndarray]:
        """Return completed steps (B,) along which the skin leaps through the indenter.

        On the way it is deeper inside (`way` (B,) [T], just measured) than at both ends, by more
        than the tip has moved.

        Returns:
            By environment, the undeformed place of the skin that is deepest (3,) [T].
        """
        assembly, state = self._assembly, self._assembly.state
        allowed = np.maximum(PASSED * assembly.finest, np.linalg.norm(state.step, axis=1))
        may_be = good & (way > self._deepest + allowed)
        if not may_be.any():
            return {}
        places = {}
        for i in np.flatnonzero(may_be).tolist():
            mesh, overlap = self._meshes[i], assembly.rows(assembly.face_overlap, [i])[0, :, 0]
            places[i] = mesh.nodes[mesh.faces[np.argmax(overlap)]].mean(axis=0)
        end = assembly.overlap(state.mask(may_be), samples=PATH_SAMPLES)[:, 0]
        return {i: place for i, place in places.items() if way[i] > end[i] + allowed[i]}

    def _too_deep(
        self, env: int, deep: float, place: np.ndarray, touched: np.ndarray, kind: _Kind
    ) -> _Passed | None:
        """Return what to say of an overlap, or None if it is small for the contact.

        Args:
            env: Environment.
            deep: Depth of the overlap [T].
            place: Undeformed place of it (3,) [T].
            touched: Nodes of the top that touch (X, Y).
            kind: What overlaps.
        """
        mesh, unit = self._meshes[env], self._scenes[env].body.thickness
        x, y, place = mesh.x * unit, mesh.y * unit, place * unit
        width, tip = np.array([width_of(touched, x, y)]), self._tip[[env]] * unit
        (fraction,) = _shares(np.array([deep * unit]), width, tip, unit)
        if fraction <= OVERLAP_MOST:
            return None
        where = kind.words.format(_where(place, deep * unit, kind.inside, fraction))
        return _Passed(where, finer_at(place, x, y, mesh.fineness), kind.brief)

    def _is_rounding(self, env: int) -> bool:
        """True if a step failed so close to its tolerance that float32 rounding is the limit.

        A smaller step would fail too.
        """
        if self._numerics.precision != "auto" or self._assembly.precision != "float32":
            return False
        tolerance = self._numerics.tolerance
        return bool(tolerance < self._newton.residual[env] < ROUNDING * tolerance)

    def _augmentations(self, force: float, env: int) -> int:
        if not force:
            return 0
        fades = force < FADED_BELOW * self._largest[env]
        return self._numerics.augmentations + (FADED if fades else 0)

    def _take(self, good: np.ndarray, way: np.ndarray, folds: dict[int, tuple[float, int]]) -> None:
        if not good.any():
            return
        assembly = self._assembly
        kept: dict[int, int] = {}
        work = self._newton.work(good, self._duration)
        for i in np.flatnonzero(good).tolist():
            path = self._paths[i]
            self._spent[i].steps += 1
            self._last[i] = path.segment, self._share[i] - path.fraction
            self._collectors[i].moved(float(work[i]), way[i])
            self._deepest[i] = way[i, 0]
            frame = path.segment
            floor = NEARLY_CRUSHED * self._numerics.det_floor
            if path.accept(self._share[i], nearly_crushed=bool(assembly.sums.det[i] < floor)):
                kept[i] = frame
        if kept:
            self._keep(kept, folds)
        assembly.accept(good, self._duration)
        if self._progress is not None:
            done = sum(path.segment + path.fraction - 1 for path in self._paths)
            whole = sum(max(len(path.corners) - 2, 1) for path in self._paths)
            self._progress(max(done, 0.0) / whole)

    def _keep(self, kept: dict[int, int], folds: dict[int, tuple[float, int]]) -> None:
        """Keep current states as frames, given by environment."""
        assembly, some, unit = self._assembly, list(kept), self._scenes[0].body.thickness
        keeping = np.isin(np.arange(len(self._paths)), some)
        assembly.measure_overlap(assembly.state.mask(keeping), samples=FRAME_SAMPLES)
        read, top = assembly.read(some, self._tip)
        surface = top[..., :3] * unit
        traction = top[..., 3:] / self._area[some] * self._stress[some]
        sums, residual, depth = assembly.sums, self._newton.residual, -self._tip[:, 2]
        for row, (i, frame) in enumerate(kept.items()):
            deep, node = folds.get(i, (0.0, -1))
            told = (
                *(depth[i], residual[i], sums.base[i], sums.det[i], assembly.min_force_scale[i]),
                *(deep, node, self._spent[i]),
            )
            self._collectors[i].keep(frame, read[row], surface[row], traction[row], told)
            self._unmeasured.append(self._collectors[i])
            self._spent[i] = Spent()
        rounds = [i for i in kept if self._collectors[i].round is not None]
        if rounds:
            columns = assembly.rows(assembly.state.u, rounds).astype(float)
            faces = assembly.rows(assembly.touched, rounds)
            for i, u, touched in zip(rounds, columns, faces, strict=True):
                self._collectors[i].keep_round(kept[i], u, touched, self._tip[i])

    def _measure(self, is_busy: Callable[[], bool]) -> None:
        """Measure the contacts of kept frames, press by press, while a GPU is busy.

        Those left at the end are measured for the results.
        """
        while self._unmeasured and is_busy():
            self._unmeasured.popleft().measure()

    def _diverged(self, env: int, through: _Passed | None = None) -> SimulationDiverged:
        path, scene = self._paths[env], self._scenes[env]
        state = self._assembly.state
        dump = File(tempfile.mkdtemp(prefix="diverged-")) / "state.npz"
        try:
            np.savez_compressed(
                dump,
                scene=json.dumps(repr(scene)),
                tip=state.tip_before[env] * scene.body.thickness,
                u=state.u_old.numpy()[env] * scene.body.thickness,
                nodes=self._meshes[env].nodes * scene.body.thickness,
            )
        except OSError:
            dump = None
        where = path.corners[path.segment] + path.fraction * (
            path.corners[path.segment + 1] - path.corners[path.segment]
        )
        weight = ""
        if path.ramped and path.segment == 0:
            pull = ", ".join(f"{value:g}" for value in scene.effects.gravity.acceleration)
            weight = (
                f" under {100 * path.fraction:.3g} % of gravity's ({pull}) m/s^2, applied "
                "in steps (the body may be too soft to carry its weight)"
            )
        millimetres = where * scene.body.thickness * 1e3
        told = through is not None and path.ended == through.why  # it says what is allowed
        advice = "" if told else _advice(scene)
        missing = "no converged state" if through is None else "no state without overlap"
        diverged = (SimulationDiverged if through is None else Crossed)(
            f"{missing} after the tip at ({millimetres[0]:.4g}, {millimetres[1]:.4g}, "
            f"{millimetres[2]:.4g}) mm, on the way to waypoint {path.segment}{weight}: "
            f"{path.ended + '; ' if path.ended else ''}"
            f"{len(path.tried)} steps failed, the last: {path.tried[-1]}; "
            f"{advice}{self._assembly.precision}; state: {dump or 'could not be written'}",
            tried=tuple(path.tried),
            dump=dump,
        )
        if isinstance(diverged, Crossed):
            mesh, unit = self._meshes[env], scene.body.thickness
            diverged.wanted, diverged.record = through.wanted, self._record()
            diverged.surface_x, diverged.surface_y = mesh.x * unit, mesh.y * unit
        return diverged

    def _of_one(self, env: int) -> dict:
        """Return the record entries of one environment."""
        mesh, collector, body = self._meshes[env], self._collectors[env], self._scenes[env].body
        shape = self._record()["mesh"]
        shape["finest"] = mesh.finest * body.thickness
        shape["topmost"] = mesh.topmost * body.thickness
        shape["resolved"] = collector.resolved()
        if self._numerics.follows:
            shape["fineness"] = round(mesh.fineness, 4)
        return {
            "mesh": shape,
            **(told := collector.record()),
            "warnings": self._warnings(env, told),
        }

    def _warnings(self, env: int, told: dict) -> list[str]:
        """Return warnings about errors of this result, `told` by its frames, beyond tolerances."""
        scene, mesh, asked = self._scenes[env], self._meshes[env], self._numerics.fineness
        radius = scene.indenter.sharpest
        element = mesh.finest * scene.body.thickness
        reported = []
        if self._numerics.follows and mesh.fineness < 0.99 * asked:
            reported.append(
                f"the contact is meshed with a fineness of {mesh.fineness:.2g}, not the requested "
                f"{asked:g}, which needs more than {self._numerics.elements_max} elements"
            )
        if radius < 0.99 * element:
            reported.append(
                f"edge radius {radius * 1e3:.3g} mm is below the element's {element * 1e3:.3g} mm: "
                "the force depends on the mesh and on the path; allowed without this warning: a "
                "finer mesh or a rounder edge"
            )
        sides = ((SIDES[name], frames) for name, frames in told.items() if name in SIDES)
        reported += [f"{what}, at waypoints {frames}" for what, frames in sides]
        return reported

    def _record(self) -> dict:
        assembly = self._assembly
        return {
            "tier": "fem",
            "mesh": {
                "cells": list(assembly.mesh.cells),
                "elements": len(assembly.mesh.elements),
                "nodes": len(assembly.mesh.nodes),
            },
            "precision": assembly.precision,
            "device": str(assembly.device),
            "environments": assembly.environments,
            "effects": list(assembly.effects),
            "seconds": {name: round(value, 4) for name, value in self._seconds.items()},
        }
