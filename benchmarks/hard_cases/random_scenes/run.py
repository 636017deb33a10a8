"""Draw scenes, judge them in parallel, shrink failures, and report the results."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from benchmarks.hard_cases.planted import planted
from benchmarks.hard_cases.random_scenes.judgement import CLASSES, SceneOutcome, Settings, judge
from benchmarks.hard_cases.random_scenes.scenes import FOLDER, drawn
from benchmarks.hard_cases.random_scenes.shrink import failure, shrunk, snippet, store
from benchmarks.processes import done_counts, side_by_side
from recorder.progress import duration

# Outcomes that fail a run.
WRONG = frozenset({"silent", "crash"})


@dataclass(frozen=True, slots=True)
class RandomRun:
    """Selection of the scenes, and solver settings."""

    count: int
    seed: int = 0
    first: int = 0
    """Number of the first scene."""
    settings: Settings = field(default_factory=Settings)
    folder: Path = FOLDER
    """Folder for counter-examples."""
    mistake: str | None = None
    """Deliberate bug to inject into the solver."""
    shrinks: bool = True


@dataclass(frozen=True, slots=True)
class Told:
    """Result for one drawn scene."""

    name: str
    what: str
    outcome: SceneOutcome
    seconds: float
    plain: SceneOutcome | None = None
    """Outcome of the simplified counter-example."""
    stored: Path | None = None
    """Path of the counter-example."""


def judge_one(plan: RandomRun, index: int) -> Told:
    """Draw a scene, solve and judge it in this process, and shrink it if it fails."""
    began = time.perf_counter()
    plain: SceneOutcome | None = None
    path: Path | None = None
    with planted(plan.mistake):
        one = drawn(plan.seed, index, plan.folder)
        outcome = judge(one, plan.settings)
        if outcome.kind in WRONG and one.scene is not None and plan.shrinks:
            scene, plain = shrunk(one.scene, outcome, plan.settings)
            path = plan.folder / f"{one.seed}-{one.index}-{'-'.join(sorted(failure(plain)))}.json"
            store(path, scene, plain, one.name)
    return Told(one.name, one.what, outcome, time.perf_counter() - began, plain, path)


def judge_all(
    plan: RandomRun, *, processes: int = 2, say: Callable[[str], None] = print
) -> list[Told]:
    """Judge all scenes, reporting each with the time left, and return the results in order.

    After Ctrl-C, only completed scenes are returned.
    """
    began = time.perf_counter()
    indices = range(plan.first, plan.first + plan.count)
    told: list[Told] = []
    with done_counts(say):
        for one in side_by_side(partial(judge_one, plan), indices, plan.settings.device, processes):
            told.append(one)
            left = (time.perf_counter() - began) * (plan.count / len(told) - 1)
            say(_line(one, len(told), plan.count, left))
            if one.plain is not None and one.plain.scene is not None:
                say(f"      {one.stored}\n{_indented(snippet(one.plain.scene))}")
    return sorted(told, key=lambda one: int(one.name.split("/")[1]))


def _line(one: Told, done: int, count: int, left: float) -> str:
    outcome = one.outcome
    text = f"[{done:{len(str(count))}}/{count}] {outcome.kind:8} {one.name:<8} {one.what}"
    text += f"  {one.seconds:.1f} s" + ("" if done == count else f"   {duration(left)} left")
    return f"{text}\n      {outcome.why}" if outcome.why and not outcome.passed else text


def _indented(text: str) -> str:
    return "\n".join(f"        {line}" for line in text.splitlines())


def by_class(told: Sequence[Told]) -> dict[str, int]:
    """Return the number of scenes of each class, including empty classes."""
    counts = Counter(one.outcome.kind for one in told)
    return {kind: counts[kind] for kind in CLASSES}


def tell(told: Sequence[Told]) -> bool:
    """Print the count by class and the summary; return True if any scene failed."""
    print(", ".join(f"{count} {kind}" for kind, count in by_class(told).items()))
    passed = sum(one.outcome.passed for one in told)
    print(f"{len(told)} cases, {passed} passed")
    return any(one.outcome.kind in WRONG for one in told)
