"""Is the error of leaving effects out what the plan states? On random scenes with weak effects.

Each scene is planned with `effects="needed"`, and solved with all effects and without the omitted
ones on the same default mesh.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.accuracy.wording import percent, rounded, seconds
from benchmarks.hard_cases.random_scenes.dice import Dice
from benchmarks.hard_cases.random_scenes.scenes import Drawn, drawn
from sim.fem import Fem
from sim.fem.mesh import meshes_of
from sim.fem.sizing import stages_of
from sim.fem.stepping import path_of
from sim.metrics import force_errors, outcome_of
from sim.needed import FINENESS, plan_many
from sim.result import Outcome, Result
from sim.scene import Effects, Friction, Gravity, Inertia, Scene, Viscosity
from sim.tiers import simulate_many

Row = dict[str, Any]

TOLERANCE, LIMIT = "2 %", 0.02
# Maximum steps of a motion and elements of a probe's mesh, for scenes that take seconds.
STEPS_MAX, COARSE_MAX = 15, 700
# Maximum number of elements in the meshes that check the plans.
ELEMENTS_MAX = 6000
# Offset of a scene's number, to draw its effects from a separate random stream.
EFFECTS_STREAM = 1_000_000


def sensible(seed: int, first: int, folder: Path) -> Iterator[Drawn]:
    """Yield the scenes of a seed that are typical uses, from number `first` on."""
    for index in itertools.count(first):
        one = drawn(seed, index, folder)
        if one.scene is not None and one.what.startswith("sensible"):
            yield one


def scenes_of(seed: int, first: int, count: int, folder: Path) -> list[Drawn]:
    """Return sensible scenes, with two or more effects drawn again, some weak."""
    chosen: list[Drawn] = []
    for one in sensible(seed, first, folder):
        assert one.scene is not None
        effects = _effects(Dice(seed, EFFECTS_STREAM + one.index))
        scene = replace(one.scene, effects=effects)
        if _steps(scene) <= STEPS_MAX and _elements(scene) <= COARSE_MAX:
            chosen.append(replace(one, scene=scene))
            if len(chosen) == count:
                break
    return chosen


def _effects(dice: Dice) -> Effects:
    """Return two to four effects, each weak as often as strong."""
    while True:
        branches = dice.whole(1, 2)
        effects = Effects(
            Friction(dice.scaled(1e-3, 1.0)) if dice.chance(0.6) else None,
            Viscosity(
                tuple(dice.scaled(1e-3, 1.0) for _ in range(branches)),
                tuple(dice.scaled(1e-4, 10.0) for _ in range(branches)),
            )
            if dice.chance(0.5)
            else None,
            Inertia(dice.one_of([1.0, 1.0, 100.0])) if dice.chance(0.6) else None,
            Gravity(dice.one_of([(0.0, 0.0, -9.81), (0.0, 0.0, 9.81), (9.81, 0.0, 0.0)]))
            if dice.chance(0.6)
            else None,
        )
        if len(effects.key) >= 2:
            return effects


def _steps(scene: Scene) -> int:
    """Return the number of steps of the motion, without rejected ones."""
    path = path_of(scene, Fem())
    total = 0
    for segment in range(1, len(scene.motion)):
        path.segment = segment
        total += round(1 / path.limit)
    return total


def _elements(scene: Scene) -> int:
    """Return the number of elements of a probe's mesh, as planned before it is solved."""
    sizes = [stage.sizes for stage in stages_of(scene)]
    numerics = Fem(fineness=FINENESS)
    return sum(len(one.elements) for one in meshes_of([scene] * len(sizes), numerics, sizes))


def compared(one: Drawn) -> Row:
    """Plan a scene, and compare with both solutions if any effect is omitted."""
    scene = one.scene
    assert scene is not None
    (planned,) = plan_many([scene], tolerance=TOLERANCE)
    row: Row = {
        "scene": one.name,
        "effects": list(scene.effects.key),
        "left_out": list(planned.omitted),
        "probe_seconds": rounded(planned.seconds),
    }
    if not planned.omitted:
        return row
    full, full_seconds = _solved(scene)
    less, less_seconds = _solved(planned.needed)
    row |= {
        "stated": rounded(planned.joint.value("fraction")),
        "seconds": rounded(full_seconds),
        "seconds_without": rounded(less_seconds),
        "error": None,
    }
    if isinstance(full, Result) and isinstance(less, Result):
        _, fraction = force_errors(outcome_of(less), outcome_of(full))
        row["error"] = rounded(float(fraction.max()))
    return row


def _solved(scene: Scene) -> tuple[Outcome, float]:
    began = time.perf_counter()
    (outcome,) = simulate_many([scene], Fem(elements_max=ELEMENTS_MAX))
    return outcome, time.perf_counter() - began


def section(some: Sequence[Row]) -> str:
    """Return gain and cost of leaving effects out, in words."""
    if not some:
        return ""
    less = [row for row in some if row.get("error") is not None]
    within = sum(row["error"] <= LIMIT for row in less)
    as_stated = sum(row["error"] <= row["stated"] for row in less)
    worst = max(less, key=lambda row: float(row["error"]), default=None)
    saved = sum(row["seconds"] - row["seconds_without"] for row in less)
    text = (
        f'**Effects left out** by `plan(scene, "{TOLERANCE}", effects="needed")`: of {len(some)} '
        f"scenes with two or more effects {len(less)} lose some, and are solved with and without "
        f"them on the same mesh. The error is within {TOLERANCE} in {within}, and within what the "
        f"plan states in {as_stated}"
    )
    if worst is not None:
        error, stated = percent(worst["error"]), percent(worst["stated"])
        text += f"; the largest is {error}, where {stated} is stated"
    probes = sum(row["probe_seconds"] for row in some)
    return f"{text}. Leaving out saved {seconds(saved)}, the probes took {seconds(probes)}."
