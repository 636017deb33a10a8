"""The command `speed-shared`: its options, and a run on a few presses."""

from __future__ import annotations

import pytest
from support.commands import run_module

from benchmarks.sim.speed import processes
from benchmarks.sim.speed.forces import extrapolated
from sim.errors import SceneError


@pytest.mark.parametrize("spacings", ["1,1.2,1.5", "1.5,1", "-1,1"])
def test_spacings_are_one_or_a_finer_and_a_coarser_one(spacings: str) -> None:
    with pytest.raises(SceneError, match=r"--spacings: .*; allowed: one, or a finer and a coarser"):
        run_module(processes, f"--spacings={spacings}")


def test_two_meshes_are_extrapolated_by_the_ratio_of_their_spacings() -> None:
    sphere, cone = ("sphere", 0.0, 0.0, 0.3), ("cone", 0.0, 0.0, 0.3)
    # An error that falls with the square of the spacing: 1 N without it.
    fine, coarse = {sphere: 1.0 + 1.0**2, cone: 1.0}, {sphere: 1.0 + 1.5**2}
    assert extrapolated(fine, coarse, 1.5) == {sphere: pytest.approx(1.0)}  # type: ignore[arg-type, comparison-overlap]


@pytest.mark.slow
def test_a_few_presses_are_timed_and_judged(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_module(processes, "--smoke", "--spacings", "1.333", "--repeat", "1") == 0
    printed = capsys.readouterr().out
    assert "without a solution: 0 on 1.333 mm" in printed
    assert "then: " in printed
