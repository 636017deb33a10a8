import json
import math
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.__main__ import main
from benchmarks.hard_cases.laws import (
    Law,
    Laws,
    at_least,
    at_most,
    difference,
    evidence,
    rises,
    smooth,
)
from benchmarks.hard_cases.mistakes import MISTAKES
from benchmarks.hard_cases.named_cases import CASES, QUICK, chosen, judge
from benchmarks.hard_cases.solver import Solver, by_hand
from sim.errors import SimulationDiverged

# In less than a second or so; the others are slow.
FAST = (
    "poisson-0-3", "never-touches", "inertia-of-no-mass", "repeats",
    "phases-without-time", "metres-and-millimetres", "stays-elastic-when-rested",
    "sags-under-gravity", "diverges-in-a-batch",
)  # fmt: skip


@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in FAST else pytest.mark.slow) for n in CASES]
)
def test_every_case_passes(name: str) -> None:
    assert judge(Solver(), name)["failures"] == []


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name == "force-scaled" else pytest.mark.slow)
        for name in MISTAKES
    ],
)
def test_a_wrong_solver_is_noticed_by_its_case(name: str) -> None:
    """The right one passes: see above."""
    mistake = MISTAKES[name]
    assert judge(mistake.solver, mistake.case)["failures"]


def test_there_are_cases_of_each_family_and_each_says_what_it_asserts() -> None:
    assert len(CASES) == 99
    assert all(case.says.endswith(".") for case in CASES.values())
    assert set(QUICK) <= set(CASES)


@pytest.mark.parametrize(
    ("law", "holds", "used"),
    [
        (at_most("x", 1.0, 2.0), True, 0.5),
        (at_most("x", 2.0, 2.0), True, 1.0),
        (at_most("x", 2.001, 2.0), False, pytest.approx(1.0005)),
        (at_most("x", -math.inf, 1.0), False, math.inf),
        (at_most("x", math.nan, 1.0), False, math.inf),
        (at_most("x", 0.0, 0.0), True, 0.0),
        (at_most("x", 1.0, 0.0), False, math.inf),
        (at_least("x", 4.0, 2.0), True, 0.5),
        (at_least("x", 1.999, 2.0), False, pytest.approx(1.0005)),
        (at_least("x", -0.5, -1.0), True, 0.5),
        (at_least("x", math.inf, 1.0), False, math.inf),
    ],
    ids=str,
)
def test_a_law_holds_up_to_its_limit_and_says_how_near(law: Law, holds: bool, used: float) -> None:
    assert (law.holds, law.used) == (holds, used)


def test_difference_is_relative_and_infinite_for_unlike_shapes() -> None:
    assert difference([1.0, -4.0], [1.0, -3.0]) == 0.25
    assert difference([1.0], [1.0, 1.0]) == math.inf


def test_smooth_sees_a_jump_and_rises_sees_a_fall() -> None:
    line = [0.0, 1.0, 2.0, 3.0, 4.0]
    assert smooth(line, 1e-12).holds
    assert smooth([0.0, 1.0, 3.0, 4.0, 5.0], 0.1).measured == pytest.approx(0.2)
    assert rises("x", line).holds
    assert not rises("x", [0.0, 2.0, 1.0]).holds


def test_a_divergence_without_evidence_breaks_its_laws() -> None:
    assert not all(law.holds for law in evidence(SimulationDiverged("nothing kept")))


def _diverges(_solver: Solver) -> Laws:
    raise SimulationDiverged("no state")


def _crashes(_solver: Solver) -> Laws:
    return [at_most("one over zero", 1 / 0, 1.0)]


def _measures_nothing(_solver: Solver) -> Laws:
    return []


def _breaks_a_law(_solver: Solver) -> Laws:
    return [at_least("a|b", 0.25, 0.5)]


@pytest.mark.parametrize(
    ("laws", "message"),
    [
        (_diverges, "no converged state: no state"),
        (_crashes, "ZeroDivisionError"),
        (_measures_nothing, "no law was measured"),
        (_breaks_a_law, "a|b: 0.25 ≥ 0.5"),
    ],
)
def test_the_command_fails_with_a_case_and_says_why(
    laws: Callable[[Solver], Laws],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setitem(CASES, "never-touches", by_hand(laws))
    page = tmp_path / "page.md"
    options = ["--only", "cases", "--case", "never-*", "--processes", "1", "--out", str(page)]
    assert main(["hard-cases", *options]) == 1
    assert f"FAILED: cases: never-touches: {message}" in capsys.readouterr().out
    assert f"`never-touches`: {message}".replace("|", "\\|") in page.read_text()
    stored = json.loads(page.with_suffix(".json").read_text())["cases"]["results"]
    assert list(stored) == ["never-touches"]


def test_a_pattern_that_matches_nothing_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert chosen(["rim-*"]) == ["rim-8-mm", "rim-10-mm", "rim-11-5-mm"]
    assert main(["hard-cases", "--case", "rym"]) == 2
    assert "no case is called 'rym'" in capsys.readouterr().err
    assert main(["hard-cases", "--device", "rym"]) == 2


@pytest.mark.slow
def test_worker_processes_judge_and_the_page_has_each_part(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    assert main(["hard-cases", "--quick", "--seconds", "300", "--out", str(page)]) == 0
    text = page.read_text()
    assert f"**{len(QUICK)} cases, {len(QUICK)} passed.**" in text
    assert all(title in text for title in ("## Cases", "## Deliberate", "## Random", "## Hard"))
    assert (tmp_path / "images" / "page-laws.png").exists()
