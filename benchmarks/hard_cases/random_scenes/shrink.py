"""Simplify a counter-example while the same law stays broken."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.hard_cases.random_scenes.dice import rounded
from benchmarks.hard_cases.random_scenes.judgement import SceneOutcome, Settings, judge_scene
from sim.errors import SceneError
from sim.result import from_json, to_json
from sim.scene import Body, Effects, Motion, Scene, through

# Maximum number of simplifications to try, and their time limit [s].
TRIES, SECONDS = 30, 30.0
# Fields whose numbers are not rounded, because they depend on others or are close to a limit.
EXACT = frozenset({"cosine", "time", "poisson"})

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
    for change in (_at_once, _bare, _without_each, _fewer, _centred, _upright, _plain_gel, _round):
        try:
            for simpler in change(scene):
                if simpler != scene:
                    yield simpler
        except SceneError:
            continue


def _at_once(scene: Scene) -> Iterator[Scene]:
    """Yield the press straight down to the deepest point."""
    x, y, z = min(scene.motion.tip, key=lambda tip: tip[2])
    if z < 0 and len(scene.motion) > 2:
        yield replace(scene, motion=Motion(((x, y, 0.0), (x, y, z)), (0.0, 1.0)))


def _bare(scene: Scene) -> Iterator[Scene]:
    yield replace(scene, effects=Effects())


def _without_each(scene: Scene) -> Iterator[Scene]:
    for name in scene.effects.key:
        yield replace(scene, effects=replace(scene.effects, **{name: None}))


def _fewer(scene: Scene) -> Iterator[Scene]:
    """Yield scenes without the last waypoints, or without one waypoint."""
    tip, time_ = scene.motion.tip, scene.motion.time
    for count in (len(tip) // 2, len(tip) - 1):
        if count >= 1:
            yield replace(scene, motion=Motion(tip[:count], time_[:count]))
    for index in range(1, len(tip) - 1):
        left = [place for place in range(len(tip)) if place != index]
        motion = Motion(tuple(tip[i] for i in left), tuple(time_[i] for i in left))
        yield replace(scene, motion=motion)


def _centred(scene: Scene) -> Iterator[Scene]:
    x, y, _ = scene.motion.tip[0]
    tips = tuple((a - x, b - y, c) for a, b, c in scene.motion.tip)
    yield replace(scene, motion=replace(scene.motion, tip=tips))


def _upright(scene: Scene) -> Iterator[Scene]:
    yield replace(scene, indenter=scene.indenter.upright)


def _plain_gel(scene: Scene) -> Iterator[Scene]:
    plain, body = Body(), scene.body
    yield replace(scene, body=replace(body, dome_radius=None))
    yield replace(scene, body=replace(body, modulus=plain.modulus, poisson=plain.poisson))
    yield replace(scene, body=replace(body, size_y=body.size_x))


def _round(scene: Scene) -> Iterator[Scene]:
    """Yield scenes whose numbers have one or two digits."""
    if scene.indenter.solid is not None:
        return
    for digits in (1, 2):
        fewer = from_json(Scene, _rounded(to_json(scene), digits), "scene")
        apart = all(a != b for a, b in zip(fewer.motion.tip, fewer.motion.tip[1:], strict=False))
        slow = scene.effects.viscosity is None and scene.effects.inertia is None
        if apart and slow:
            fewer = replace(fewer, motion=through(fewer.motion.tip, speed=10e-3))
        yield fewer


def _rounded(value: Any, digits: int) -> Any:
    if isinstance(value, dict):
        return {
            name: item if name in EXACT else _rounded(item, digits) for name, item in value.items()
        }
    if isinstance(value, list):
        return [_rounded(item, digits) for item in value]
    return rounded(value, digits) if isinstance(value, float) else value


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
