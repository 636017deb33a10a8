"""Failures of the finite-element tier: it reports them and returns no result."""

import json
from dataclasses import replace
from pathlib import Path as File
from typing import Any

import numpy as np
import pytest

from sim import (
    Body,
    Effects,
    Friction,
    Inertia,
    Result,
    Scene,
    SimulationDiverged,
    Viscosity,
    press,
    simulate,
)
from sim.error_estimate import with_estimate
from sim.fem import Fem, Precision
from sim.fem.newton import PATIENT, PATIENT_IN_ALL, Newton
from sim.fem.outcome import checked
from sim.fem.solver import _remeshed, precision_for_finer, simulate_fem
from sim.fem.stepping import CRUSHED_MOST, Path, path_of
from sim.indenters import flat_punch, sphere

BODY = Body(size_x=8e-3, size_y=8e-3, thickness=4e-3)
SPACING = 4e-3 / 3
SCENE = Scene(sphere(3e-3), press([0.5e-3]), BODY)
CRIPPLED = Fem(spacing=SPACING, precision="float64", newton_max=1, halvings=1)


@pytest.fixture(autouse=True)
def _dumps_in_a_folder_of_the_test(tmp_path: File, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))


def test_a_crippled_solver_diverges_with_what_it_tried_and_a_dump_that_loads() -> None:
    with pytest.raises(SimulationDiverged, match="no converged state") as caught:
        simulate(SCENE, CRIPPLED)
    diverged = caught.value
    assert len(diverged.tried) == CRIPPLED.halvings + 1
    assert all("Newton iterations, residual" in line for line in diverged.tried)
    assert "waypoint" in str(diverged)
    assert diverged.dump is not None
    assert str(diverged.dump) in str(diverged)
    with np.load(diverged.dump) as state:
        assert state["u"].shape == state["nodes"].shape == (9 * 9 * 4, 3)
        assert np.isfinite(state["u"]).all()
        assert state["tip"].shape == (3,)
        assert "sphere" in json.loads(str(state["scene"]))


def test_waypoints_that_were_reached_have_their_answers() -> None:
    brief = Fem(spacing=SPACING, precision="float64", newton_max=8, halvings=0)
    deep = replace(SCENE, motion=press([0.1e-3, 0.5e-3, 3e-3]))
    with pytest.raises(SimulationDiverged, match="on the way to waypoint 3") as caught:
        simulate(deep, brief)
    reached = caught.value.reached
    assert reached.scene.motion.tip == deep.motion.tip[:3]
    shallow = simulate(replace(deep, motion=press([0.1e-3, 0.5e-3])), brief)
    np.testing.assert_array_equal(reached.wrench, shallow.wrench)
    assert reached.record["error"] == shallow.record["error"]
    with pytest.raises(SimulationDiverged) as caught:
        simulate(SCENE, CRIPPLED)
    assert caught.value.reached is None


def test_a_result_stands_if_a_finer_mesh_has_no_solution_and_its_error_has_the_overlap() -> None:
    (result,) = simulate_fem([SCENE], Fem(fineness=0.3))
    assert isinstance(result, Result)
    kept = _remeshed(SimulationDiverged("lost; state: x.npz"), 1, result)
    assert isinstance(kept, Result)
    np.testing.assert_array_equal(kept.wrench, result.wrench)
    assert kept.record["warnings"][-1].endswith("finer mesh, which has no solution: lost")
    stated = [with_estimate(one).record["error"]["percent"] for one in (result, kept)]
    overlap = 100 * float(result.quality.overlap[1]) / 0.5e-3
    assert stated[1] == pytest.approx(np.hypot(stated[0], 2 * overlap), rel=0.01)


def test_a_solver_that_diverges_says_so_where_its_state_cannot_be_written(
    tmp_path: File, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "none"))
    with pytest.raises(SimulationDiverged, match="state: could not be written") as caught:
        simulate(SCENE, CRIPPLED)
    assert caught.value.dump is None


@pytest.mark.parametrize(("edge", "advised"), [(0.05e-3, True), (0.4e-3, False)])
def test_a_press_with_a_sharp_edge_that_diverges_is_told_of_it(edge: float, advised: bool) -> None:
    scene = replace(SCENE, indenter=flat_punch(2e-3, edge))
    with pytest.raises(SimulationDiverged) as caught:
        simulate(scene, CRIPPLED)
    assert ("at an edge of 0.05 mm, sharp for a depth of 0.5 mm" in str(caught.value)) == advised


def test_nothing_unconverged_is_returned() -> None:
    """For any tolerance, every frame's residual is below it."""
    slid = Scene(
        sphere(3e-3), press([0.3e-3], shear=0.2e-3, steps=1), BODY, Effects(friction=Friction(0.4))
    )
    largest = []
    for tolerance in (3e-2, 1e-2, 1e-3):
        numerics = Fem(spacing=SPACING, precision="float64", tolerance=tolerance)
        residual = simulate(slid, numerics).quality.residual
        assert (residual <= tolerance).all()
        largest.append(residual.max() / tolerance)
    assert max(largest) > 0.3, "no frame came close to its tolerance: this would not see a slip"


@pytest.mark.parametrize("precision", ["auto", "float64"])
def test_a_body_flatter_than_allowed_is_not_returned_nor_tried_in_ever_smaller_steps(
    precision: Precision, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sim.fem.newton.DET_FLOOR", 0.99)
    monkeypatch.setattr("sim.fem.stepping.DET_FLOOR", 0.99)
    never_flat = Fem(spacing=SPACING, precision=precision)
    with pytest.raises(SimulationDiverged, match="waypoint 1: elements are crushed") as caught:
        simulate(SCENE, never_flat)
    assert len(caught.value.tried) == CRUSHED_MOST


def test_steps_that_crush_elements_end_a_path_only_where_they_were_nearly_crushed_before() -> None:
    path = path_of(SCENE, Fem(spacing=SPACING))
    path.accept(1.0)
    for _attempt in range(CRUSHED_MOST):
        assert path.refuse(path.goal()[0], "", crushed=True)
    path.accept(path.goal()[0], nearly_crushed=True)
    assert path.refuse(path.goal()[0], "", crushed=True)
    path.accept(path.goal()[0], nearly_crushed=True)
    assert path.refuse(path.goal()[0], "", crushed=True)
    assert path.refuse(path.goal()[0], "")
    assert not path.refuse(path.goal()[0], "", crushed=True)


def test_a_path_has_a_budget_of_patient_iterations() -> None:
    path = path_of(SCENE, Fem(spacing=SPACING))
    path.accept(1.0)
    assert path.patience(60) == PATIENT
    path.patient_left = 30
    assert path.patience(60) == 1.5
    path.patient_left = -4
    assert path.patience(60) == 1.0
    assert path.refuse(path.goal()[0], "")  # an ordinary step may fail, and be halved
    assert not path.refuse(path.goal()[0], "")
    assert "iterations" in path.ended


def test_all_patient_steps_of_a_press_draw_on_its_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    """An update of the multipliers may take long too, and is made to fail with the budget spent."""
    monkeypatch.setattr("sim.fem.stepping.PATIENCE", -PATIENT_IN_ALL)
    left = []
    patience = Path.patience

    def kept(path: Path, newton_max: int) -> float:
        left.append(path.patient_left)
        return patience(path, newton_max)

    monkeypatch.setattr(Path, "patience", kept)
    simulate(SCENE, Fem(spacing=SPACING, precision="float64"))
    assert left[0] == PATIENT_IN_ALL
    assert left[-1] <= 0


def test_float32_that_cannot_reach_the_tolerance_goes_on_in_float64_and_says_why() -> None:
    numerics = Fem(spacing=SPACING, tolerance=1e-9, halvings=1, newton_max=20)
    result = simulate(SCENE, numerics)
    assert result.record["precision"] == "float64"
    assert "float32 did not converge" in result.record["precision_reason"]
    assert (result.quality.residual <= 1e-9).all()
    with pytest.raises(SimulationDiverged, match="float32"):
        simulate(SCENE, replace(numerics, precision="float32"))


def test_float32_that_reaches_the_tolerance_stays_and_gives_no_reason() -> None:
    record = simulate(SCENE, Fem(spacing=SPACING)).record
    assert record["precision"] == "float32"
    assert "precision_reason" not in record


@pytest.mark.slow
def test_float32_is_given_up_when_a_halved_step_fails_too() -> None:
    numerics = Fem(spacing=SPACING, tolerance=1e-9, newton_max=12)
    assert ": 2 steps failed" in simulate(SCENE, numerics).record["precision_reason"]
    with pytest.raises(SimulationDiverged, match=": 13 steps failed"):
        simulate(SCENE, replace(numerics, precision="float32"))


@pytest.mark.slow
def test_float64_goes_on_from_the_last_state_that_float32_has_accepted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With all history that a state can have; float32 is made to fail on the way to waypoint 2.

    Forces are those of float64 alone, within 2e-4, and float64 does not begin again.
    """
    effects = Effects(
        friction=Friction(0.5),
        viscosity=Viscosity(ratios=(0.4, 0.3), times=(0.01, 1.0)),
        inertia=Inertia(scale=1e3),
    )
    scene = Scene(sphere(3e-3), press([0.3e-3], shear=0.2e-3, steps=2), BODY, effects)
    numerics = Fem(spacing=SPACING, tolerance=1e-4)
    (wanted,) = simulate_fem([scene], replace(numerics, precision="float64"))
    began: list[float] = []
    begin = Newton.begin

    def failing(newton: Newton, chosen: np.ndarray, *given: Any, **named: Any) -> None:
        begin(newton, chosen, *given, **named)
        assembly = newton._assembly
        deep = assembly.state.tip_before[:, 2] < -0.12e-3 / BODY.thickness
        if assembly.precision == "float32":
            newton.failed |= chosen & deep
        else:
            began.append(assembly.state.tip_before[0, 2])

    monkeypatch.setattr(Newton, "begin", failing)
    (found,) = simulate_fem([scene], numerics)
    assert isinstance(found, Result)
    assert isinstance(wanted, Result)
    assert found.record["precision"] == "float64"
    assert began[0] < -0.12e-3 / BODY.thickness
    largest = np.abs(wanted.wrench).max()
    assert found.wrench == pytest.approx(wanted.wrench, abs=2e-4 * largest)


def test_a_step_is_patient_after_shorter_ones_have_failed_at_the_same_place() -> None:
    path = path_of(SCENE, Fem(spacing=SPACING))
    path.accept(1.0)  # the way to the body, which has no length
    patient = []
    for _attempt in range(7):
        patient.append(path.patient)
        assert path.refuse(path.goal()[0], "")
    assert patient == [False, False, True, False, False, True, False]
    path.accept(path.goal()[0])
    assert not path.patient
    path.go_on(3)
    assert path.patient


def test_finer_meshes_are_solved_in_float64_where_a_coarser_one_was() -> None:
    single = simulate(SCENE, Fem(spacing=SPACING))
    double = simulate(SCENE, Fem(spacing=SPACING, precision="float64"))
    assert precision_for_finer(double, Fem()) == "float64"
    assert precision_for_finer(single, Fem()) == "auto"
    assert precision_for_finer(double, Fem(precision="float32")) == "float32"


def test_a_column_that_may_have_buckled_says_so_however_little_of_it_still_touches() -> None:
    """The width on the upright column counts: one that has bent touches with an edge."""
    column = Body(size_x=4e-3, size_y=4e-3, thickness=20e-3)
    result = simulate(Scene(sphere(4e-3), press([0.5e-3]), column), Fem(spacing=1e-3))
    edge = replace(result.quality, contact_width=result.quality.contact_width / 10)
    bent = replace(result, quality=edge, record={**result.record, "warnings": []})
    for one in (result, checked(bent)):
        assert isinstance(one, Result)
        assert any("may buckle" in warning for warning in one.record["warnings"])
    sturdy = replace(column, thickness=4e-3)
    result = simulate(Scene(sphere(4e-3), press([0.5e-3]), sturdy), Fem(spacing=1e-3))
    assert not any("may buckle" in warning for warning in result.record["warnings"])
