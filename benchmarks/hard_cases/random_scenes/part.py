"""Part `random`: randomly drawn scenes, judged by the referee, failing ones made plain."""

from __future__ import annotations

import time
from collections import Counter
from functools import partial
from typing import Any

from benchmarks.hard_cases.random_scenes.judgement import (
    CLASSES,
    WRONG,
    SceneOutcome,
    Settings,
    judge,
)
from benchmarks.hard_cases.random_scenes.referee import LAWS
from benchmarks.hard_cases.random_scenes.scenes import FOLDER, drawn
from benchmarks.hard_cases.random_scenes.shrink import shrunk, store
from benchmarks.hard_cases.solver import Solver
from benchmarks.processes import rows_of
from benchmarks.report import Page, Run, table
from sim.scene import Scene

# Scenes of a quick run: one held, one beside the gel, one refused.
QUICK = (28, 43, 59)


def judge_drawn(settings: Settings, seed: int, index: int) -> dict[str, Any]:
    """Draw a scene, solve and judge it in this process, and shrink and store it if it fails."""
    began = time.perf_counter()
    one = drawn(seed, index)
    outcome = judge(one, settings)
    values = {
        "scene": one.name,
        "what": one.what,
        "class": outcome.kind,
        "why": outcome.why,
        "laws": sorted({name for name, _ in outcome.laws}),
        "broken": sorted({name for name, _ in outcome.broken}),
        "silent": sorted(outcome.failure),
        "seconds": round(time.perf_counter() - began, 1),
    }
    if outcome.kind in WRONG and one.scene is not None:
        values |= _plain(one.name, one.scene, outcome, settings)
    return values


def _plain(name: str, scene: Scene, outcome: SceneOutcome, settings: Settings) -> dict[str, Any]:
    """Simplify and store a counter-example; return its file and the code that solves it."""
    plain, again = shrunk(scene, outcome, settings)
    path = FOLDER / f"{name.replace('/', '-')}-{'-'.join(sorted(again.failure))}.json"
    store(path, plain, again, name)
    return {"stored": str(path), "plain": repr(plain)}


def measure(run: Run) -> list[dict[str, Any]]:
    """Judge the scenes."""
    options = run.options
    indices = QUICK if run.quick else range(options.first, options.first + options.scenes)
    run.seeds = [options.seed]
    judging = partial(judge_drawn, Settings(Solver(run.device), options.seconds), options.seed)
    outcomes = [*rows_of(run, judging, {f"scene {index}": index for index in indices}).values()]
    for values in outcomes:
        if values["class"] in WRONG:
            file = f"; made plain: {values['stored']}" if "stored" in values else ""
            run.failures.append(f"{values['scene']}: {values['why']}{file}")
    return outcomes


def section(outcomes: list[dict[str, Any]], _page: Page) -> str:
    """Return tables by class and family, by law, and of failures."""
    families = sorted({one["what"].split(", ")[0] for one in outcomes})
    counts = Counter((one["class"], one["what"].split(", ")[0]) for one in outcomes)
    classes = [
        [kind, means, *(counts[kind, family] for family in families)]
        for kind, means in CLASSES.items()
    ]
    tallies = {
        key: Counter(law for one in outcomes for law in one[key])
        for key in ("laws", "broken", "silent")
    }
    laws = [
        [law, statement(law), *(tallies[key][law] for key in tallies)]
        for law in sorted(tallies["laws"])
    ]
    bad = [one for one in outcomes if one["class"] in (*WRONG, "timeout")]
    rows = [
        [one["scene"], one["class"], one["what"], one["why"].replace("|", "\\|")] for one in bad
    ]
    minutes = sum(one["seconds"] for one in outcomes) / 60
    return "\n\n".join(
        [
            "## Random scenes",
            "Indenters, gels, places, motions and effects are drawn: sensible ones, traps that are "
            "known to break simulators, and absurd ones. A referee that shares no code with the "
            "solver checks each result against laws of mechanics; it reads force, surface and "
            "traction, not the solver's own measures. One scene in three is also solved as a twin: "
            "mirrored, ten times as large, or pressed at once. A scene that fails is simplified "
            f"while the same law stays broken, and stored. {len(outcomes)} scenes, {minutes:.0f} "
            "minutes of one process.",
            table(["class", "means", *families], classes),
            table(["law", "statement", "measured", "broken", "without a warning"], laws),
            *([table(["scene", "class", "what", "laws or message"], rows)] if rows else []),
        ]
    )


def statement(law: str) -> str:
    """Return the law's text."""
    others = {
        "finite": "All numbers are finite.",
        "symmetric": "A mirror-symmetric scene has mirror-symmetric forces.",
    }
    if law not in LAWS:
        return others.get(law, "The twin scene has the same forces.")
    return " ".join((LAWS[law].__doc__ or "").split("\n\n")[0].split())
