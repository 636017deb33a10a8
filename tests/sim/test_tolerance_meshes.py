"""Solver accuracy and meshes required by a tolerance."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

import sim.tolerance as module
from sim import Body, Effects, Layer, Scene, SceneError, plan, press, replay
from sim.error_estimate import with_estimate
from sim.errors import SimulationDiverged
from sim.fem import Fem, matrix, solver
from sim.fem.in_time import time_steps
from sim.fem.sizing import Sizes, Span
from sim.fem.solver import Required, simulate_fem
from sim.fem.stepping import OutOfTime
from sim.indenters import sphere
from sim.metrics import Tolerance
from sim.result import Outcome, Result
from sim.scene import Viscosity, beginning_of
from sim.tiers import simulate
from sim.tolerance import STATES_MOST, first_mesh, simulate_within

BALL = Scene(sphere(4e-3), press([0.3e-3]))
WET = replace(BALL, effects=Effects(viscosity=Viscosity((0.5,), (0.1,))))


@pytest.mark.parametrize(
    ("scene", "fraction", "tolerance", "path"),
    [
        (BALL, 0.02, 2e-4, 2e-3),
        (BALL, 0.5, STATES_MOST, 10 * STATES_MOST),
        (BALL, 1e-4, 1e-4, 1e-3),
        (WET, 0.02, 2e-4, None),
    ],
    ids=["two per cent", "coarse", "finest", "history"],
)
def test_states_are_as_exact_as_a_tolerance_asks(
    scene: Scene, fraction: float, tolerance: float, path: float | None
) -> None:
    states = first_mesh(scene, Tolerance("fraction", fraction), "cpu")
    assert states.tolerance == pytest.approx(tolerance)
    assert states.path_tolerance == (None if path is None else pytest.approx(path))


@pytest.mark.slow
def test_what_a_solution_asks_for_the_next_mesh_has() -> None:
    key = 0, len(BALL.motion)
    far_too_coarse = Span(-3e-3, 3e-3, 1.5e-3)
    required = Required({key: Sizes((far_too_coarse,), (far_too_coarse,), 1.5e-3, 2e-3)})
    numerics = Fem(fineness=0.5, tolerance=1e-3)
    (first,) = simulate_fem([BALL], numerics, required=required)
    assert isinstance(first, Result)
    assert "made_anew" not in first.record["mesh"]
    assert required.sizes[key].x != (far_too_coarse,)
    (second,) = simulate_fem([BALL], numerics, required=required)
    assert isinstance(second, Result)
    assert "made_anew" not in second.record["mesh"]
    alone = simulate(BALL, numerics)
    np.testing.assert_allclose(second.force, alone.force, rtol=0.02, atol=1e-4)
    assert second.record["mesh"]["elements"] > 2 * first.record["mesh"]["elements"]


@pytest.mark.slow
def test_states_of_a_contact_far_smaller_than_the_thickness_are_balanced() -> None:
    """The force is 2 mN, a thirtieth of the least force that the thickness alone would suggest."""
    scene = Scene(sphere(0.5e-3), press([0.05e-3]), Body(80e-3, 80e-3, 20e-3))
    loose, exact = (
        simulate(scene, Fem(fineness=0.3, tolerance=one, path_tolerance=one)).force
        for one in (1e-2, 1e-5)
    )
    np.testing.assert_allclose(loose[-1, 2], exact[-1, 2], rtol=0.01)


@pytest.mark.slow
def test_a_light_touch_is_balanced_well_enough_for_a_tolerance() -> None:
    scene = Scene(sphere(20e-3), press([0.02e-3]), Body(34e-3, 34e-3, 4e-3))
    forces = []
    wanted = Tolerance("fraction", 0.01), Tolerance("fraction", 0.03)
    for tolerance in (*(first_mesh(scene, one, "cpu").tolerance for one in wanted), 1e-5):
        (found,) = simulate_fem([scene], Fem(fineness=0.95, tolerance=tolerance))
        assert isinstance(found, Result)
        forces.append(found.force[-1, 2])
    np.testing.assert_allclose(forces[:2], forces[2], rtol=2e-3)


def test_the_best_answer_stands_where_finer_meshes_have_none(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    dump = tmp_path / "diverged" / "state.npz"
    solved: list[float] = []
    fails_above = 0.7
    assert time_steps(BALL, Fem(), "cpu") is None

    def simulate(scenes: list[Scene], numerics: Fem, **how: Any) -> list[Outcome]:
        solved.append(round(numerics.fineness, 3))
        if numerics.fineness > fails_above:
            dump.parent.mkdir()
            dump.touch()
            return [SimulationDiverged(f"lost; state: {dump}", tried=(), dump=dump)]
        return simulate_fem(scenes, numerics, **how)

    monkeypatch.setattr(solver, "simulate_fem", simulate)
    monkeypatch.setattr(module, "EXPECTED", 1e-6)
    monkeypatch.setattr(module, "FIRST_LEAST", 0.3)
    result = simulate_within(BALL, "0.5 %", tier="fem")
    plan = result.record["plan"]
    assert solved == pytest.approx([0.1875, 0.3, 0.6, 1.2], abs=0.01)
    assert not plan["reached"]
    assert plan["why"] == "lost"
    assert plan["notes"][0].startswith("0.5 % was not reached: ")
    assert result.record["error"]["status"] == "measured"
    assert not dump.parent.exists()
    fails_above = 0.0
    with pytest.raises(SimulationDiverged, match="lost"):
        simulate_within(BALL, "0.5 %", tier="fem")


def test_within_a_time_the_best_answer_is_given_and_its_plan_replays_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Whatever the machine: one mesh fits into the time, and then none."""
    entries = ["fineness 0.25", "fineness 0.48", "fineness 0.48"]

    def fitting(*_mesh: Any) -> float:
        monkeypatch.setattr(module, "HOPE", 0.0)
        return 0.48

    monkeypatch.setattr(module._Search, "_fitting", fitting)
    result = plan(BALL, "0.5 %", seconds=1e3, only="fem").run()
    entry = result.record["plan"]
    assert [one.split(":")[0] for one in entry["tried"]] == entries
    assert entry["why"] == "no time for a finer mesh"
    assert not entry["reached"]
    assert "it needs a fineness of about" in entry["notes"][0]
    again = replay(result)
    np.testing.assert_array_equal(again.wrench, result.wrench)
    np.testing.assert_array_equal(again.surface, result.surface)
    assert again.record["error"] == result.record["error"]
    with pytest.raises(SimulationDiverged, match=r"no solution in 1e-09 s; .*more seconds"):
        plan(BALL, "0.5 %", seconds=1e-9, only="fem").run()
    with pytest.raises(SceneError, match=r"plan.seconds: 0 s; allowed: above 0"):
        plan(BALL, "0.5 %", seconds=0)
    with pytest.raises(SceneError, match="without a plan"):
        replay(simulate(BALL, Layer()))


def test_a_first_mesh_that_takes_too_long_or_has_no_state_is_followed_by_a_coarser_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    begin = [0.3, 0.2, 0.15]

    def simulate(scenes: list[Scene], numerics: Fem, **how: Any) -> list[Outcome]:
        if numerics.fineness == begin[0]:
            raise OutOfTime
        if numerics.fineness == begin[1]:
            return [SimulationDiverged("lost")]
        return simulate_fem(scenes, numerics, **how)

    monkeypatch.setattr(solver, "simulate_fem", simulate)
    monkeypatch.setitem(module.QUICK, "cpu", tuple(begin))
    monkeypatch.setattr(module, "HOPE", 0.0)
    result = plan(BALL, "0.5 %", seconds=1e3, only="fem").run()
    entry = result.record["plan"]
    assert entry["tried"][:2] == ["fineness 0.3: out of its part of the time", "fineness 0.2: lost"]
    assert result.record["mesh"]["fineness"] == pytest.approx(begin[2])
    np.testing.assert_array_equal(replay(result).wrench, result.wrench)


def test_meshes_that_follow_their_contacts_may_have_one_topology() -> None:
    scenes = [replace(BALL, indenter=sphere(radius)) for radius in (4e-3, 3e-3)]
    outcomes = simulate_fem(scenes, Fem(fineness=0.3, one_topology=True))
    cells = [one.record["mesh"]["cells"][:2] for one in outcomes if isinstance(one, Result)]
    assert cells[0] == cells[1]


@pytest.mark.slow
def test_a_press_without_a_solution_goes_on_with_a_skin_that_stiffens(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = replace(BALL, motion=press([0.3e-3, 2.2e-3]))
    real = solver._solve

    def folds(*arguments: Any) -> list[Outcome]:
        (whole,) = real(*arguments)
        assert isinstance(whole, Result)
        diverged = SimulationDiverged("the skin folds; state: none")
        (diverged.reached,) = real([beginning_of(scene, 2)], *arguments[1:])
        return [diverged]

    monkeypatch.setattr(solver, "_solve", folds)
    (result,) = simulate_fem([scene], Fem(fineness=0.4))
    assert isinstance(result, Result)
    entry = result.record["stiffening"]
    assert entry["coefficients"] == [3.0, 12.0]
    assert entry["waypoint"] == 2
    assert result.record["stages"][-1]["waypoints"] == 2
    assert 0.3 < entry["correction"][2] < 0.9
    assert any("from waypoint 2 on the skin stiffens" in one for one in result.record["warnings"])
    stated = with_estimate(result).record["error"]["force"]
    without = {name: value for name, value in result.record.items() if name != "stiffening"}
    plainly = with_estimate(replace(result, record=without)).record["error"]["force"]
    assert stated[1] == plainly[1]
    assert stated[2] == pytest.approx(np.hypot(plainly[2], entry["correction"][2]), rel=0.01)
    monkeypatch.setattr(solver, "_solve", real)
    soft = simulate(scene, Fem(spacing=1e-3))
    off = abs(result.force[2, 2] / soft.force[2, 2] - 1)
    assert off < stated[2] / 4 + soft.record["error"]["force"][2]
    required = Required(stiffer={(0, len(scene.motion)): "no state"})
    (again,) = simulate_fem([scene], Fem(fineness=0.4), required=required)
    assert isinstance(again, Result)
    assert again.record["stiffening"]["waypoint"] == 0
    assert again.record["mesh"]["fineness"] == 0.4
    assert again.force[2, 2] == pytest.approx(result.force[2, 2], rel=0.1)
    for where in (solver, matrix):  # so that no two fit side by side
        monkeypatch.setattr(where, "NODES_SIDE_BY_SIDE", 10)
    with pytest.raises(ValueError, match="2 matrices of 11 nodes; allowed: 10, or one"):
        matrix.zero_blocks(2, 11, wp.mat33d, "cpu", parallel=True)
    (apart,) = simulate_fem([scene], Fem(fineness=0.4), required=required)
    assert isinstance(apart, Result)
    np.testing.assert_allclose(apart.force, again.force, atol=1e-6 * abs(again.force).max())
