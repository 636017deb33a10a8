"""Presses with the material-point method: known errors, and properties that must hold exactly."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from scipy.interpolate import RegularGridInterpolator

from sim import Body, Effects, Friction, Result, Scene, SimulationDiverged, press
from sim.indenters import flat_punch, plane, sphere
from sim.mpm import AUTHORS_VOLUME, Mpm, lattice, state
from sim.mpm.solver import end_of_line, simulate_mpm
from sim.scene import through
from sim.store import load_result, save_results

pytestmark = pytest.mark.slow

# Depths, and the force there on the paper's gel, frictionless [N]; two element families agree to
# 0.1 %.
DEPTHS, FORCE = (0.5e-3, 1.0e-3, 1.5e-3), (0.2652, 0.9197, 1.9560)
SMALL = Body(size_x=8e-3, size_y=8e-3, thickness=4e-3)
COARSE = Mpm(cell=1e-3)
SCENE = Scene(sphere(4e-3), press([0.3e-3, 0.6e-3]), SMALL)


def _one(scene: Scene, numerics: Mpm = COARSE) -> Result:
    outcome = simulate_mpm([scene], numerics)[0]
    assert isinstance(outcome, Result), outcome
    return outcome


def around(result: Result, radius: float) -> tuple[float, float]:
    """Return height and outward motion of the surface at this radius [m], mean over 4 sides."""
    # Along the axes: the free sides let the diagonals move more.
    sides = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    field = RegularGridInterpolator((result.surface_x, result.surface_y), result.surface[-1])
    moved = field(radius * sides)
    return float(moved[:, 2].mean()), float((moved[:, :2] * sides).sum(axis=1).mean())


@pytest.fixture(scope="module")
def coarse() -> Result:
    """The press of the references on a coarse grid."""
    return _one(Scene(sphere(4e-3), press(DEPTHS)))


@pytest.fixture(scope="module")
def small() -> Result:
    return _one(SCENE)


def test_a_coarse_press_is_within_the_methods_known_error(coarse: Result) -> None:
    error = -coarse.force[1:, 2] / np.array(FORCE) - 1
    # O(cell): too stiff at first contact, too soft at depth. Finite elements are within 4 % here.
    assert 0.1 < error[0] < 0.6
    assert -0.35 < error[2] < -0.1


def test_a_well_sampled_body_bulges_and_moves_outwards_around_the_contact(coarse: Result) -> None:
    up, outward = around(coarse, 6e-3)
    assert 0.01e-3 < up < 0.06e-3
    assert 0.05e-3 < outward < 0.25e-3


def test_what_the_indenter_pushes_the_base_holds(coarse: Result) -> None:
    assert (coarse.quality.balance[1:] < 0.12).all()
    assert np.abs(coarse.force[1:, :2]).max() < 1e-3
    assert np.abs(coarse.wrench[1:, 3:]).max() < 1e-5


def test_work_goes_into_the_material_but_for_a_tenth(coarse: Result) -> None:
    assert (coarse.quality.energy_gap[1:] > 0).all()
    assert (coarse.quality.energy_gap[1:] < 0.15).all()
    assert coarse.record["kinetic_over_stored"] < 0.02


def test_a_symmetric_press_gives_a_symmetric_surface(small: Result) -> None:
    # The grid starts at one corner: mirrored positions only differ by rounding.
    last = small.surface[-1]
    np.testing.assert_allclose(last[..., 2], last[::-1, :, 2], atol=1e-8)
    np.testing.assert_allclose(last[..., 0], -last[::-1, :, 0], atol=1e-8)
    np.testing.assert_allclose(last[..., 0], last[..., 1].T, atol=1e-8)


def test_a_run_repeats_to_the_last_bit(small: Result) -> None:
    again = _one(SCENE)
    np.testing.assert_array_equal(again.wrench, small.wrench)
    np.testing.assert_array_equal(again.surface, small.surface)


@pytest.mark.gpu
@pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device")
def test_on_a_gpu_a_run_repeats_to_the_last_bit_and_is_the_cpus_to_five_digits(
    small: Result,
) -> None:
    first, again = (simulate_mpm([SCENE, SCENE], COARSE, device="cuda:0") for _ in range(2))
    runs = [one for one in (*first, *again) if isinstance(one, Result)]
    assert len(runs) == 4
    for one in runs:
        np.testing.assert_array_equal(one.wrench, runs[0].wrench)
        np.testing.assert_array_equal(one.surface, runs[0].surface)
    np.testing.assert_allclose(runs[0].force, small.force, atol=5e-5 * np.abs(small.force).max())


def test_a_press_in_a_batch_is_the_press_alone_to_the_last_bit(small: Result) -> None:
    stiff = replace(SMALL, modulus=1e6, poisson=0.3)
    other = Scene(flat_punch(2e-3, 0.5e-3), press([0.9e-3], at=(1e-3, 0.0)), stiff)
    third = Scene(sphere(2e-3), press([0.1e-3, 0.2e-3, 0.3e-3], speed=0.1), SMALL)
    batch = [one for one in simulate_mpm([other, SCENE, third], COARSE) if isinstance(one, Result)]
    assert len(batch) == 3
    alone = [_one(other), small, _one(third)]
    for batched, single in zip(batch, alone, strict=True):
        np.testing.assert_array_equal(batched.wrench, single.wrench)
        np.testing.assert_array_equal(batched.surface, single.surface)
        np.testing.assert_array_equal(batched.quality.energy_gap, single.quality.energy_gap)
    assert batch[0].record["environments"] == 3


def test_force_scales_with_the_modulus_and_with_nothing_else(small: Result) -> None:
    soft = _one(replace(SCENE, body=replace(SMALL, modulus=1e4, density=20_000.0)))
    np.testing.assert_allclose(soft.force / 1e4, small.force / 0.145e6, rtol=2e-5, atol=1e-12)


def test_float32_is_float64_to_five_digits(small: Result) -> None:
    exact = _one(SCENE, replace(COARSE, precision="float64"))
    np.testing.assert_allclose(exact.force, small.force, atol=2e-5 * np.abs(small.force).max())


def test_a_slipping_plane_drags_with_its_coefficient_times_the_pressure() -> None:
    way = [(0.0, 0.0, 0.0), (0.0, 0.0, -0.3e-3), (2e-3, 0.0, -0.3e-3)]
    scene = Scene(plane(), through(way, speed=0.01), SMALL, Effects(friction=Friction(0.1)))
    force = _one(scene).force[-1]
    assert force[0] / -force[2] == pytest.approx(0.1, rel=0.02)
    assert abs(force[1]) < 1e-3 * force[0]


def test_the_authors_sticking_contact_drags_the_surface_along() -> None:
    way = [(0.0, 0.0, 0.0), (0.0, 0.0, -0.3e-3), (0.2e-3, 0.0, -0.3e-3)]
    scene = Scene(sphere(4e-3), through(way, speed=0.02), Body(4e-3, 4e-3, 2e-3))
    sticky = _one(scene, Mpm.authors())
    middle = len(sticky.surface_x) // 2
    assert 0.12e-3 < sticky.surface[-1, middle, middle, 0] < 0.2e-3
    assert sticky.force[1, 2] < 0 < sticky.force[2, 0]


def test_a_fast_press_is_met_by_the_bodys_mass(monkeypatch: pytest.MonkeyPatch) -> None:
    # Before a wave returns from the base, the pressure on a plane is density * c * v.
    monkeypatch.setattr(lattice, "WINDOW", 0.5)
    monkeypatch.setattr(lattice, "SPEED_RATIO", 0.02)
    body = replace(SMALL, poisson=0.0)
    scene = Scene(plane(), press([0.02 * 0.8 * body.thickness]), body)
    result = _one(scene, Mpm(cell=0.25e-3))
    record = result.record
    density = body.density * record["mass_scaling"]
    expected = density * record["wave_speed"] * record["tip_speed"] * body.size_x * body.size_y
    assert -result.force[-1, 2] == pytest.approx(expected, rel=0.06)


def test_a_dome_is_pressed_with_the_force_that_elements_give_within_the_known_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(state, "REACH", 0.0)
    monkeypatch.setattr(lattice, "SAFETY", 0.8)
    dome = replace(SMALL, dome_radius=12e-3)
    numerics = Mpm(cell=0.5e-3)
    domed, ball = (
        _one(Scene(shape, press([0.8e-3]), dome), numerics).force[-1, 2]
        for shape in (plane(), sphere(4e-3))
    )
    # From finite elements; on a flat body the plane would need -2.78 N.
    assert domed == pytest.approx(-1.47, rel=0.25)
    assert ball == pytest.approx(-0.451, rel=0.25)


def test_a_squeezed_particle_ends_its_press_and_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state, "DET_FLOOR", 0.9)
    deep = replace(SCENE, motion=press([0.6e-3, 2.5e-3]))
    shallow = replace(SCENE, motion=press([0.05e-3]))
    failed, kept = simulate_mpm([deep, shallow], COARSE)
    assert isinstance(failed, SimulationDiverged)
    assert "squeezed to nothing" in str(failed)
    assert failed.tried[0].startswith("step ")
    assert isinstance(kept, Result)
    np.testing.assert_array_equal(kept.wrench, _one(shallow).wrench)


def test_an_unstable_time_step_diverges_and_gives_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lattice, "SAFETY", 2.0)
    outcome = simulate_mpm([SCENE], COARSE)[0]
    assert isinstance(outcome, SimulationDiverged)
    assert "Courant number 2" in str(outcome)


def test_a_press_that_is_not_quasi_static_or_loosely_sampled_says_so(small: Result) -> None:
    assert small.record["warnings"] == []
    fast = replace(SCENE, motion=press([0.1e-3], speed=0.05))
    reported = _one(fast, Mpm.authors()).record
    assert reported["speed_ratio"] > 0.03
    assert "not quasi-static" in reported["warnings"][1]
    assert "loose columns" in reported["warnings"][0]


def test_a_result_says_what_ran_and_is_stored(small: Result, tmp_path: Path) -> None:
    record = small.record
    assert record["tier"] == small.tier == "mpm"
    assert record["particles"] == 16 * 16 * 8
    assert record["particles_per_cell"] == pytest.approx(8.0)
    assert record["speed_ratio"] == pytest.approx(0.01)
    assert small.quality.steps.sum() == record["steps"]
    assert np.isnan(small.traction).all()
    save_results(tmp_path / "press", [small])
    loaded = load_result(tmp_path / "press")
    np.testing.assert_array_equal(loaded.surface, small.surface)
    assert loaded.record == record


def test_progress_rises_to_one() -> None:
    fractions: list[float] = []
    simulate_mpm([SCENE], COARSE, progress=fractions.append)
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0


def test_the_end_of_a_line_does_not_lag() -> None:
    assert end_of_line(3 + 0.5 * np.arange(20.0)) == pytest.approx(3 + 0.5 * 19)
    assert end_of_line(np.full((7, 2), 4.0)) == pytest.approx([4.0, 4.0])
    assert end_of_line(np.array([1.0, 5.0])) == 5.0


@pytest.mark.timeout(600)
def test_halving_the_cell_halves_the_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state, "REACH", 0.0)
    scene = Scene(sphere(4e-3), press(DEPTHS))
    errors = [-_one(scene, Mpm(cell=cell)).force[-1, 2] / FORCE[-1] - 1 for cell in (1e-3, 0.5e-3)]
    assert -0.32 < errors[1] < -0.25
    assert errors[1] / errors[0] == pytest.approx(0.6, abs=0.1)


@pytest.mark.timeout(1200)
def test_the_authors_settings_lose_the_force_and_the_motion_around_the_contact() -> None:
    result = _one(Scene(sphere(4e-3), press(DEPTHS)), Mpm.authors())
    force = -result.force[1:, 2] * 0.2e-3**3 / AUTHORS_VOLUME
    assert (force / np.array(FORCE) < 0.3).all()
    up, outward = around(result, 5e-3)
    assert up < -0.01e-3
    assert outward < -0.01e-3
    up, outward = around(result, 8e-3)
    assert abs(up) < 0.005e-3
    assert abs(outward) < 0.005e-3
