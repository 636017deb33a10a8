"""The judge of random scenes detects deliberate bugs in the solver."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from benchmarks.hard_cases.planted import MISTAKES, planted
from benchmarks.hard_cases.random_scenes import run
from benchmarks.hard_cases.random_scenes.judgement import SceneOutcome, Settings, judge_scene
from benchmarks.hard_cases.random_scenes.scenes import drawn
from benchmarks.hard_cases.random_scenes.shrink import failure


def _judged(index: int, settings: Settings, folder: Path, mistake: str | None) -> SceneOutcome:
    scene = drawn(0, index, folder).scene
    assert scene is not None
    with planted(mistake):
        return judge_scene(scene, settings)


# By bug: a scene of seed 0 that is right without it, the precision, and the law it violates.
CAUGHT = {
    "full-integration": (94, "auto", "near-layer"),
    "lagged-friction": (62, "auto", "coulomb"),
    # A state that float32 normally reaches is not found, in 12 halvings of the step or in the time
    # of a solve, whichever is over first: no law is violated, but it is reported.
    "energy-line-search": (2, "float32", None),
}
# Node-only contact stays within the stated error on meshes that follow the contact; the cases
# `flat-punch-between-bounds` and `flat-punch-off-the-grid`, on uniform elements, detect it.
HARMLESS_HERE = {"nodal-contact"}


@pytest.mark.slow
@pytest.mark.parametrize("mistake", CAUGHT)
def test_a_planted_mistake_is_caught_on_a_scene_that_is_right_without_it(
    mistake: str, tmp_path: Path
) -> None:
    index, precision, law = CAUGHT[mistake]
    settings = Settings(precision=precision)  # type: ignore[arg-type]
    assert _judged(index, settings, tmp_path, None).kind in {"right", "warned"}
    wrong = _judged(index, settings, tmp_path, mistake)
    if law is None:
        assert wrong.kind in {"diverged", "timeout"}
    else:
        assert law in failure(wrong)


def test_every_mistake_is_tried() -> None:
    assert set(CAUGHT) | HARMLESS_HERE == set(MISTAKES)


def test_a_mistake_is_planted_while_a_scene_is_judged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    active: list[str | None] = []
    judged: list[list[str | None]] = []

    @contextmanager
    def recorded(mistake: str | None) -> Iterator[None]:
        active.append(mistake)
        yield
        active.pop()

    def judge(*_scene: object, **_given: object) -> SceneOutcome:
        judged.append(list(active))
        return SceneOutcome("right", "")

    monkeypatch.setattr(run, "planted", recorded)
    monkeypatch.setattr(run, "judge", judge)
    told = run.judge_one(
        run.RandomRun(1, 0, 0, mistake="nodal-contact", folder=tmp_path, shrinks=False), 0
    )
    assert told.name == "0/0"
    assert judged == [["nodal-contact"]]
