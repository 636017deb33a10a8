"""Regression tests of scenes with silently wrong results, found by `hard-cases`.

Once a scene of `found/` is fixed, its reason is removed here and the file stays.
"""

import json
from contextlib import suppress
from pathlib import Path

import pytest

from benchmarks.hard_cases.random_scenes.mechanics import silent_laws
from benchmarks.hard_cases.solver import Solver
from benchmarks.processes import OutOfTime, time_limit
from sim.errors import SimulationDiverged
from sim.fem import Fem
from sim.result import from_json
from sim.scene import Scene

FOUND = sorted((Path(__file__).parent / "found").glob("*.json"))
# Reason why a result is still silently wrong.
NOT_YET: dict[str, str] = {}


def _case(path: Path) -> object:
    reason = NOT_YET.get(path.stem)
    marks = [pytest.mark.xfail(strict=True, reason=reason)] if reason else []
    return pytest.param(path, id=path.stem, marks=[*marks, *SLOW.get(path.stem, [])])


# Scenes that take more than 5 seconds.
SLOW: dict[str, list[pytest.MarkDecorator]] = {
    "blade-goes-through": [pytest.mark.slow],
    "corner-below-the-base": [pytest.mark.slow],
    "corner-is-not-symmetric": [pytest.mark.slow],
    "deep-cone-leaves-the-axis": [pytest.mark.slow],
    "first-touch-is-nothing": [pytest.mark.slow],
    "leaves-the-skin": [pytest.mark.slow],
    "press-at-the-corner": [pytest.mark.slow],
    "skin-leaps-over-the-sphere": [pytest.mark.slow],
    "tube-on-its-rounded-edge": [pytest.mark.slow],
}


@pytest.mark.slow
@pytest.mark.parametrize("path", [_case(path) for path in FOUND])
def test_a_scene_once_found_is_no_longer_silently_wrong(path: Path) -> None:
    scene = from_json(Scene, json.loads(path.read_text(encoding="utf-8"))["scene"], "scene")
    with suppress(OutOfTime), time_limit(60.0):
        (outcome,) = Solver().outcomes([scene], Fem(elements_max=12_000))
        if isinstance(outcome, SimulationDiverged):
            outcome.forget_dump()
            assert "waypoint" in outcome.reason
        else:
            assert silent_laws(outcome) == []


def test_every_reason_has_its_scene_and_every_scene_says_what_it_breaks() -> None:
    assert set(NOT_YET) | set(SLOW) <= {path.stem for path in FOUND}
    assert all(json.loads(path.read_text(encoding="utf-8"))["broken"] for path in FOUND)
