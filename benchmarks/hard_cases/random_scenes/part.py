"""Part `random`: randomly drawn scenes, judged by the referee; failing ones are stored."""

from __future__ import annotations

import json
import time
from collections import Counter
from functools import partial
from typing import Any

from benchmarks.hard_cases.random_scenes.judgement import CLASSES, WRONG, judge
from benchmarks.hard_cases.random_scenes.referee import LAWS
from benchmarks.hard_cases.random_scenes.scenes import FOLDER, drawn
from benchmarks.hard_cases.solver import Solver
from benchmarks.processes import rows_of
from benchmarks.report import Page, Run, table
from sim.result import to_json

# Scenes of a quick run: one held, one beside the gel, one refused.
QUICK = (28, 43, 59)
# Statements of the laws; all others are those of twins.
STATEMENTS = {
    **{name: (law.__doc__ or "").split("\n")[0] for name, law in LAWS.items()},
    "finite": "All numbers are finite.",
    "symmetric": "A mirror-symmetric scene has mirror-symmetric forces.",
}


def judge_drawn(solver: Solver, seconds: float, seed: int, index: int) -> dict[str, Any]:
    """Draw a scene, solve and judge it in this process, and store it if it fails."""
    began = time.perf_counter()
    one = drawn(seed, index)
    outcome = judge(one, solver, seconds)
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
        twin = "".join(law.removeprefix("twin-") for law in laws if law.startswith("twin-"))
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
        [
            law,
            STATEMENTS.get(law, "The twin scene has the same forces."),
            *(t[law] for t in tallies),
        ]
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
measures. One scene in three is also solved as a twin: mirrored, ten times as large, or pressed \
at once. A scene that fails is stored. {len(outcomes)} scenes, {minutes:.0f} minutes of one \
process.

{table(["class", "means", *families], classes)}

{table(["law", "statement", "measured", "broken", "without a warning"], laws)}"""
    if failures:
        text += "\n\n" + table(["scene", "class", "what", "laws or message"], failures)
    return text
