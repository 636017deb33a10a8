from __future__ import annotations

import contextlib
import math

import numpy as np
import pytest

from benchmarks.__main__ import main
from benchmarks.hard_cases.case import Case, Run, Solver
from benchmarks.hard_cases.cases import BY_NAME, CASES, chosen
from benchmarks.hard_cases.divergence import evidence
from benchmarks.hard_cases.laws import Law, at_least, at_most, difference, rises, smooth
from benchmarks.hard_cases.page import page
from benchmarks.hard_cases.planted import DETECTING_CASES, WHAT, fully_integrated, planted
from benchmarks.hard_cases.runner import Report, run_case, run_cases
from sim.errors import SimulationDiverged
from sim.fem import assembly, matrix, stepping
from tests.support.few import few

QUICK = (
    "flat-punch-between-bounds",
    "inertia-of-no-mass",
    "metres-and-millimetres",
    "millimetres-for-metres",
    "mirror-symmetry",
    "never-touches",
    "one-newton-iteration",
    "phases-without-time",
    "poisson-0-3",
    "starts-at-touch",
    "unlike-bodies-in-a-batch",
)


@pytest.mark.parametrize("name", few(QUICK, 4))
def test_quick_cases_pass(name: str) -> None:
    assert run_case(name, "cpu", None).failures == []


@pytest.mark.parametrize(
    "mistake",
    [
        pytest.param(name, marks=() if name == "nodal-contact" else pytest.mark.slow)
        for name in DETECTING_CASES
    ],
)
def test_a_planted_mistake_is_caught_by_a_case_that_passes_without_it(mistake: str) -> None:
    name = DETECTING_CASES[mistake][0]
    assert run_case(name, "cpu", None).failures == []
    assert not run_case(name, "cpu", mistake).passed


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", sorted(set(BY_NAME) - set(QUICK)))
def test_every_other_case_passes(name: str) -> None:
    assert run_case(name, "cpu", None).failures == []


def test_there_are_more_than_forty_cases_and_each_says_what_it_asserts() -> None:
    assert len(CASES) == len(BY_NAME) > 40
    assert all(case.asserts.endswith(".") and case.seconds > 0 for case in CASES)


def test_every_mistake_has_a_case_that_must_catch_it() -> None:
    assert set(DETECTING_CASES) == set(WHAT)
    assert all(names and set(names) <= set(BY_NAME) for names in DETECTING_CASES.values())


def _solver_parts() -> dict[str, object]:
    """Return the solver parts that the deliberate bugs replace."""
    return {
        "face_rule": assembly.face_rule,
        "element_kernels": assembly.element_kernels,
        "element_rows_kernel": matrix.element_rows_kernel,
        "forces_kernel": assembly.forces_kernel,
        "blocks_kernel": matrix.blocks_kernel,
        "Newton": stepping.Newton,
    }


@pytest.mark.parametrize(
    ("mistake", "changed"),
    [
        (None, set()),
        (
            "full-integration",
            {"element_kernels", "element_rows_kernel", "forces_kernel", "blocks_kernel"},
        ),
        ("nodal-contact", {"face_rule"}),
        ("lagged-friction", {"Newton"}),
        ("energy-line-search", {"Newton"}),
    ],
)
def test_a_mistake_is_in_the_solver_only_while_it_is_planted(
    mistake: str | None, changed: set[str]
) -> None:
    before = _solver_parts()
    seen = {}
    with contextlib.suppress(ZeroDivisionError), planted(mistake):
        seen = _solver_parts()
        raise ZeroDivisionError
    assert {name for name, part in seen.items() if part != before[name]} == changed
    assert _solver_parts() == before


def test_a_mistake_that_is_not_known_is_refused() -> None:
    with pytest.raises(ValueError, match="known: full-integration"), planted("no-such-mistake"):
        pass


def test_lines_that_the_solver_no_longer_has_are_not_silently_left_right(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gone = {"sim.fem.element": (("gone", ""),)}
    monkeypatch.setattr("benchmarks.hard_cases.planted._FULL_INTEGRATION", gone)
    with pytest.raises(ValueError, match="'gone' does not occur once"):
        fully_integrated.__wrapped__("sim.fem.element")


def test_nodal_contact_has_its_points_on_the_corners() -> None:
    with planted("nodal-contact"):
        shape, weight = assembly.face_rule(2)
    assert (shape == np.eye(4)).all()
    assert weight.sum() == 4.0


@pytest.mark.slow
def test_a_mistake_is_planted_in_worker_processes_that_report_in_the_order_of_the_cases(
    capsys: pytest.CaptureFixture[str],
) -> None:
    (name, *_others) = DETECTING_CASES["nodal-contact"]
    cases = chosen([name, "never-touches", "phases-without-time"])
    reports = run_cases(cases, mistake="nodal-contact", processes=2)
    assert [report.name for report in reports] == [case.name for case in cases]
    assert {report.name for report in reports if not report.passed} == {name}
    assert "left" in capsys.readouterr().out


@pytest.mark.parametrize("measured", [1.0, -math.inf, 0.999])
def test_at_most_holds_up_to_its_limit_and_needs_a_number(measured: float) -> None:
    assert at_most("x", measured, 1.0).holds == math.isfinite(measured)
    assert not at_most("x", 1.001, 1.0).holds
    assert not at_most("x", math.nan, 1.0).holds


def test_at_least_holds_down_to_its_limit_and_needs_a_number() -> None:
    assert at_least("x", 1.0, 1.0).holds
    assert not at_least("x", 0.999, 1.0).holds
    assert not at_least("x", math.nan, -1.0).holds
    assert not at_least("x", math.inf, 1.0).holds


def test_difference_is_relative_and_infinite_for_unlike_shapes() -> None:
    assert difference([1.0, -4.0], [1.0, -3.0]) == 0.25
    assert difference([1.0], [1.0, 1.0]) == math.inf


def test_smooth_sees_a_jump_and_rises_sees_a_fall() -> None:
    line = [0.0, 1.0, 2.0, 3.0, 4.0]
    assert smooth("x", line, 1e-12).holds
    assert smooth("x", [0.0, 1.0, 3.0, 4.0, 5.0], 0.1).measured == pytest.approx(0.2)
    assert rises("x", line).holds
    assert not rises("x", [0.0, 2.0, 1.0]).holds


def test_a_divergence_without_evidence_breaks_its_laws() -> None:
    assert not all(law.holds for law in evidence(SimulationDiverged("nothing kept")))


def _diverges(_solver: Solver) -> list[Law]:
    raise SimulationDiverged("no state")


def _crashes(_solver: Solver) -> list[Law]:
    return [at_most("one over zero", 1 / 0, 1.0)]


def _measures_nothing(_solver: Solver) -> list[Law]:
    return []


@pytest.mark.parametrize(
    ("run", "message"),
    [
        (_diverges, "no converged state: no state"),
        (_crashes, "ZeroDivisionError"),
        (_measures_nothing, "no law was measured"),
    ],
)
def test_a_case_without_laws_fails_and_says_why(
    monkeypatch: pytest.MonkeyPatch, run: Run, message: str
) -> None:
    case = Case(run, seconds=1)
    monkeypatch.setitem(BY_NAME, case.name, case)
    lines: list[str] = []
    (report,) = run_cases([case], processes=1, say=lines.append)
    assert not report.passed
    assert message in report.failures[0]
    assert "FAILED" in lines[0]
    assert message in lines[1]


def test_a_pattern_that_matches_nothing_is_refused() -> None:
    assert {case.name for case in chosen(["rim-*"])} == {"rim-8-mm", "rim-10-mm", "rim-11-5-mm"}
    with pytest.raises(ValueError, match="no case is called 'rym'"):
        chosen(["rym"])


def test_the_command_tells_how_many_passed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["hard-cases", "--only", "phases-without-*", "--processes", "1"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "2 cases, 2 passed"


def test_the_command_fails_with_a_case(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(BY_NAME, "never-touches", Case(_measures_nothing, seconds=1))
    assert main(["hard-cases", "--only", "never-touches", "--processes", "1"]) == 1
    assert capsys.readouterr().out.splitlines()[-1] == "1 cases, 0 passed, 1 failed"


@pytest.mark.parametrize(
    "wrong", [["--only", "rym"], ["--planted", "rym"], ["--processes", "-1"], ["--device", "rym"]]
)
def test_the_command_refuses_wrong_options(
    wrong: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["hard-cases", *wrong]) == 2
    assert wrong[0] in capsys.readouterr().err


def test_the_page_shows_measured_and_limit_and_what_failed() -> None:
    good = Report("never-touches", (at_most("force [N]", 0.25, 0.5),), 1.0)
    bad = Report("starts-at-touch", (at_least("a|b", 0.25, 0.5),), 1.0)
    text = page([good, bad], {"nodal-contact": [bad]}, "cpu")
    assert "2 cases, 1 passed" in text
    assert "force [N]: 0.25 ≤ 0.5" in text
    assert "**FAILED** `starts-at-touch`" in text
    assert "**a\\|b: 0.25 ≥ 0.5**" in text
    assert "| nodal-contact | contact detected at nodes only | `starts-at-touch` |" in text
