"""Simplify a counter-example while the same law stays broken."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.hard_cases.random_scenes.judgement import SceneOutcome, Settings, judge_scene
from sim.errors import SceneError
from sim.result import from_json, to_json
from sim.scene import Body, Effects, Motion, Scene

# Maximum number of simplifications to try, and their time limit [s].
TRIES, SECONDS = 30, 30.0

Judge = Callable[[Scene], SceneOutcome]


def shrunk(
    scene: Scene,
    outcome: SceneOutcome,
    settings: Settings,
    *,
    seconds: float = SECONDS,
    judge: Judge | None = None,
) -> tuple[Scene, SceneOutcome]:
    """Return the simplest scene found that fails in one of the same ways, and its outcome."""
    judging = judge or (lambda simpler: judge_scene(simpler, settings, outcome.twin))
    wanted, end, tried = outcome.failure, time.monotonic() + seconds, {scene}
    while True:
        for simpler in simpler_ones(scene):
            if simpler in tried:
                continue
            if len(tried) > TRIES or time.monotonic() > end:
                return scene, outcome
            tried.add(simpler)
            again = judging(simpler)
            if again.failure & wanted:
                scene, outcome = simpler, again
                break
        else:
            return scene, outcome


def simpler_ones(scene: Scene) -> Iterator[Scene]:
    """Yield slightly simpler scenes, the largest simplifications first."""
    motion, body, plain = scene.motion, scene.body, Body()
    x, y, z = min(motion.tip, key=lambda tip: tip[2])
    first = motion.tip[0]
    centred = tuple((a - first[0], b - first[1], c) for a, b, c in motion.tip)
    # Each gives the fields that it replaces, or raises an error because no such scene exists.
    changes: list[Callable[[], dict[str, Any]]] = [
        lambda: {"motion": Motion(((x, y, 0.0), (x, y, z)), (0.0, 1.0))} if z < 0 else {},
        lambda: {"effects": Effects()},
        *(partial(_without, scene, name) for name in scene.effects.key),
        *(partial(_first_frames, motion, count) for count in (len(motion) // 2, len(motion) - 1)),
        lambda: {"motion": replace(motion, tip=centred)},
        lambda: {"indenter": scene.indenter.upright},
        lambda: {"body": replace(body, dome_radius=None)},
        lambda: {"body": replace(body, modulus=plain.modulus, poisson=plain.poisson)},
        lambda: {"body": replace(body, size_y=body.size_x)},
    ]
    for change in changes:
        try:
            simpler = replace(scene, **change())
        except SceneError:
            continue
        if simpler != scene:
            yield simpler


def _without(scene: Scene, effect: str) -> dict[str, Any]:
    return {"effects": replace(scene.effects, **{effect: None})}


def _first_frames(motion: Motion, count: int) -> dict[str, Any]:
    return {"motion": Motion(motion.tip[:count], motion.time[:count])} if count else {}


def store(path: Path, scene: Scene, outcome: SceneOutcome, name: str) -> None:
    """Write the scene as JSON, with the laws that it breaks and its origin."""
    values = {
        "name": name,
        "broken": sorted(outcome.failure),
        "said": outcome.why,
        "twin": outcome.twin,
        "scene": to_json(scene),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")


def load(path: Path) -> tuple[Scene, frozenset[str], str]:
    """Return a stored scene, the laws that it broke, and its twin's name or an empty string."""
    values = json.loads(path.read_text(encoding="utf-8"))
    return from_json(Scene, values["scene"], "scene"), frozenset(values["broken"]), values["twin"]
