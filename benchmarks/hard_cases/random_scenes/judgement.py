"""Part `random`: drawn scenes, each solved, judged and assigned to exactly one class."""

from __future__ import annotations

import json
import re
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from benchmarks.hard_cases.random_scenes.dice import Dice
from benchmarks.hard_cases.random_scenes.referee import LAWS, Named, measured
from benchmarks.hard_cases.random_scenes.scenes import FOLDER, drawn
from benchmarks.hard_cases.random_scenes.twins import KINDS, agrees, symmetric, twin_of
from benchmarks.hard_cases.solver import Solver
from benchmarks.processes import OutOfTime, rows_of, time_limit
from benchmarks.report import Page, Run, table
from sim.errors import SceneError, SimulationDiverged
from sim.result import Result, to_json
from sim.scene import Scene

CLASSES = {
    "right": "all laws hold",
    "refused": "a `SceneError` names the wrong input and the allowed range",
    "diverged": "`SimulationDiverged` states the waypoint and the attempts",
    "warned": "laws are broken, and a warning of the result covers them",
    "silent": "laws are broken, without a warning",
    "crash": "any other exception",
    "timeout": "no answer within the time for one solve",
}
# Outcomes that fail a run.
WRONG = frozenset({"silent", "crash"})
# Maximum number of elements, so that a scene takes seconds; coarsened meshes are reported.
SOLVED_MAX = 12_000
# Fraction of the scenes that are also solved as a twin.
TWINNED = 0.35

AMOUNTS = r"near-layer|rises|same-place|closed-loop|coulomb|symmetric|twin-.*|no-overlap"
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
# Scenes of a quick run: one held, one beside the gel, one refused.
QUICK = (28, 43, 59)
# Statements of the laws.
STATEMENTS = {
    **{name: (law.__doc__ or "").split("\n")[0] for name, law in LAWS.items()},
    "finite": "All numbers are finite.",
    "symmetric": "A mirror-symmetric scene has mirror-symmetric forces.",
    "twin-mirror-x": "The scene mirrored in x has mirrored forces.",
    "twin-mirror-y": "The scene mirrored in y has mirrored forces.",
    "twin-swap-xy": "The scene with x and y swapped has swapped forces.",
    "twin-ten-times": "A scene ten times (or a tenth) as large and stiff has forces to scale.",
    "twin-at-once": "The last frame, reached directly, has the same force.",
}


@dataclass(frozen=True, slots=True)
class SceneOutcome:
    """Outcome of a scene."""

    kind: str
    """One of `CLASSES`."""
    message: str = ""
    """Message of the solver or of Python."""
    laws: Sequence[Named] = ()
    """All laws that were measured."""
    silent: Sequence[str] = ()
    """Names of the broken laws that no warning covers."""

    @property
    def broken(self) -> list[Named]:
        """Laws that do not hold."""
        return [(name, law) for name, law in self.laws if not law.holds]

    @property
    def why(self) -> str:
        """One line with the broken laws, or the message."""
        return "; ".join(f"{name}: {law}" for name, law in self.broken) or self.message


def judge_scene(scene: Scene, twin: str, solver: Solver, seconds: float) -> SceneOutcome:
    """Solve a scene, and its twin of that name if it has one, and return the outcome.

    Each solve may take `seconds` [s].
    """

    def solved(scene: Scene) -> Result:
        with time_limit(seconds):
            return solver.one(scene, spacing=None, elements_max=SOLVED_MAX)

    try:
        result = solved(scene)
        laws = measured(result)
        if laws[0][1].holds:
            laws += symmetric(result)
        other = twin_of(scene, twin) if twin else None
        if other is not None:
            try:
                laws.append(agrees(result, twin, other, solved(other.scene)))
            except SimulationDiverged as diverged:
                diverged.forget_dump()  # it is no mistake of this scene
    except Exception as error:
        return unsolved(error)
    return of_laws(result, laws)


def of_laws(result: Result, laws: Sequence[Named]) -> SceneOutcome:
    """Return the outcome on a result from its laws and its own warnings."""
    warnings = result.record.get("warnings", [])
    broken = {name for name, law in laws if not law.holds}
    silent = sorted(name for name in broken if not covered(name, warnings))
    kind = "silent" if silent else "warned" if broken else "right"
    return SceneOutcome(kind, "", laws, silent)


def covered(law: str, warnings: Sequence[str]) -> bool:
    """Return True if any warning covers a violation of this law."""
    return any(
        re.search(words, warning) and re.fullmatch(laws, law)
        for warning in warnings
        for words, laws in COVERS
    )


def unsolved(error: Exception) -> SceneOutcome:
    """Return the outcome on an exception, which must state the error and the allowed range."""
    message = error.reason if isinstance(error, SimulationDiverged) else str(error)
    if isinstance(error, SimulationDiverged):
        error.forget_dump()
    if isinstance(error, OutOfTime):
        return SceneOutcome("timeout", message)
    if isinstance(error, SceneError) and "allowed" in message:
        return SceneOutcome("refused", message)
    if isinstance(error, SimulationDiverged) and "waypoint" in message:
        return SceneOutcome("diverged", message)
    place = "".join(traceback.format_tb(error.__traceback__)[-1:])
    return SceneOutcome("crash", f"{type(error).__name__}: {message} {' '.join(place.split())}")


# The part of the benchmark.


def judge_drawn(solver: Solver, seconds: float, seed: int, index: int) -> dict[str, Any]:
    """Draw a scene, solve and judge it in this process, and store it if it fails."""
    began = time.perf_counter()
    one = drawn(seed, index)
    dice = Dice(seed, -1 - index)
    twin = dice.one_of(sorted(KINDS)) if dice.chance(TWINNED) else ""
    if one.refusal is not None:
        outcome = unsolved(one.refusal)
    else:
        assert one.scene is not None
        outcome = judge_scene(one.scene, twin, solver, seconds)
    laws = sorted({name for name, _ in outcome.laws})
    values: dict[str, Any] = {
        "scene": one.name,
        "what": one.what,
        "class": outcome.kind,
        "why": outcome.why,
        "laws": laws,
        "broken": sorted({name for name, _ in outcome.broken}),
        "silent": outcome.silent,
        "seconds": round(time.perf_counter() - began, 1),
    }
    if outcome.kind in WRONG and one.scene is not None:
        path = FOLDER / f"{seed}-{index}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        stored = {"broken": outcome.silent, "twin": twin, "scene": to_json(one.scene)}
        path.write_text(json.dumps(stored, indent=1) + "\n", encoding="utf-8")
        values["why"] += f"; stored as {path}"
    return values


def measure(run: Run) -> list[dict[str, Any]]:
    """Judge the scenes."""
    options = run.options
    indices = QUICK if run.quick else range(options.first, options.first + options.scenes)
    run.seeds = [options.seed]
    judging = partial(judge_drawn, Solver(run.device), options.seconds, options.seed)
    outcomes = rows_of(run, judging, {f"scene {index}": index for index in indices})
    for values in outcomes.values():
        if values["class"] in WRONG:
            run.failures.append(f"{values['scene']}: {values['why']}")
    return list(outcomes.values())


def section(outcomes: list[dict[str, Any]], _page: Page) -> str:
    """Return tables by class and family, by law, and of failures."""
    counts = Counter((one["class"], one["what"].split(", ")[0]) for one in outcomes)
    families = sorted({family for _, family in counts})
    classes = [
        [kind, means, *(counts[kind, family] for family in families)]
        for kind, means in CLASSES.items()
    ]
    tallies = [
        Counter(law for one in outcomes for law in one[key]) for key in ("laws", "broken", "silent")
    ]
    laws = [
        [law.removeprefix("twin-"), STATEMENTS[law], *(tally[law] for tally in tallies)]
        for law in sorted(tallies[0])
    ]
    failures = [
        [one["scene"], one["class"], one["what"], one["why"].replace("|", "\\|")]
        for one in outcomes
        if one["class"] in (*WRONG, "timeout")
    ]
    minutes = sum(one["seconds"] for one in outcomes) / 60
    text = f"""## Random scenes

Indenters, gels, places, motions and effects are drawn: sensible ones, traps that are known to \
break simulators, and absurd ones. A referee that shares no code with the solver checks each \
result against laws of mechanics; it reads force, surface and traction, not the solver's own \
measures. One scene in three is also solved mirrored, ten times as large, or pressed at once. A \
scene that fails is stored. {len(outcomes)} scenes, {minutes:.0f} minutes of one process.

{table(["class", "means", *families], classes)}

{table(["law", "statement", "measured", "broken", "without a warning"], laws)}"""
    if failures:
        text += "\n\n" + table(["scene", "class", "what", "laws or message"], failures)
    return text
