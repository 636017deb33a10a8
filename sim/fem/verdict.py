"""Verdict on a solution: overlaps and lost contacts that end it, and its warnings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.errors import PassesThrough, SimulationDiverged
from sim.fem.sizing import covered
from sim.result import Outcome, Result
from sim.scene import Body, Scene

Array = NDArray[np.float64]

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
# 26 random scenes without an answer 21 have such an edge (docs/results/tolerance.md).
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


class Kind(NamedTuple):
    """A way for something to pass through the skin."""

    inside: str
    """The body that the skin is inside of."""
    words: str
    """The reason if a path ends there, with a field for where."""
    brief: str
    """The same in a few words."""


FOLD = Kind(
    "the skin beside it",
    "the skin folds and passes through itself: {}; contact of the skin with itself is not computed "
    "(allowed: a shallower press, a shorter shear, a rounder edge)",
    "the skin overlaps itself",
)
LEAP = Kind(
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
        where = overlap_place(place, deepest, f"{inside} at waypoint {worst}", fractions[worst])
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


def overlap_shares(result: Result, overlap: np.ndarray) -> np.ndarray:
    """Return the overlap of each frame (F,) over its contact's width, or over the depth if less.

    Frames without a press are divided by the thickness.
    """
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
    felt, lifted = np.any(result.force, axis=1), False
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
