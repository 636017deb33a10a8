"""Frictionless presses of the finite-element tier: force, surface, symmetry, batches."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from sim import (
    Body,
    Effects,
    Friction,
    Inertia,
    Motion,
    Result,
    Scene,
    press,
    simulate,
    simulate_many,
)
from sim.fem import Fem
from sim.indenters import flat_punch, named, sphere
from tests.support.few import few

SMALL = Body(size_x=8e-3, size_y=8e-3, thickness=4e-3)
COARSE = Fem(spacing=4e-3 / 3, precision="float64")
EXACT = Fem(spacing=4e-3 / 3, precision="float64", tolerance=1e-8)


def _arrays(result: Result) -> dict[str, np.ndarray]:
    """Return all measured arrays of a result, by name."""
    arrays = {
        name: getattr(result, name)
        for name in ("wrench", "surface_x", "surface_y", "surface", "traction")
    }
    for name in result.quality.__slots__:
        arrays[f"quality.{name}"] = getattr(result.quality, name)
    return arrays


def _results(scenes: list[Scene], numerics: Fem) -> list[Result]:
    outcomes = simulate_many(scenes, numerics)
    assert all(isinstance(outcome, Result) for outcome in outcomes)
    return [outcome for outcome in outcomes if isinstance(outcome, Result)]


def test_a_sphere_on_the_papers_gel_is_within_5_percent_of_the_fine_solution() -> None:
    """Force by two independent element families, 0.1 % apart; elements here are 1 mm."""
    scene = Scene(sphere(4e-3), press([0.5e-3, 1.0e-3, 1.5e-3]))
    result = simulate(scene, Fem(spacing=1e-3))
    assert result.record["precision"] == "float32"
    assert -result.force[1:, 2] == pytest.approx([0.2652, 0.9197, 1.9560], rel=0.05)
    # The surface 6 and 8 mm from the axis, outside the contact, moves outwards by 42.4 and 9.7 um.
    along = CubicSpline(result.surface_x, result.surface[-1, :, len(result.surface_y) // 2])
    assert along([6e-3, 8e-3])[:, 2] == pytest.approx([42.4e-6, 9.7e-6], abs=6e-6)
    assert along(6e-3)[0] == pytest.approx(139e-6, abs=10e-6)
    assert (result.quality.residual <= 1e-4).all()
    assert (result.quality.balance < 1e-3).all()
    assert result.quality.det_f_min.min() > 0.3
    # All work is stored, although the steps are long: 3e-5 to 7e-5; by their ends alone, 2e-2.
    assert np.abs(result.quality.energy_gap).max() < 1e-3


def test_a_light_touch_stores_the_work_that_it_takes() -> None:
    """In float32 its energy was what was left of terms of first order: 1.2 times the work."""
    scene = Scene(sphere(4e-3), press([5e-6]), Body(6e-3, 6e-3, 2e-3))
    result = simulate(scene, Fem(fineness=0.3))
    assert result.record["precision"] == "float32"
    assert result.force[1, 2] < 0
    assert np.abs(result.quality.energy_gap).max() < 3e-3


def test_lifting_off_returns_the_body_to_where_it_was() -> None:
    tip = ((0.0, 0.0, 0.0), (0.0, 0.0, -0.8e-3), (0.0, 0.0, 0.5e-3))
    result = simulate(Scene(sphere(3e-3), Motion(tip, (0.0, 0.1, 0.2)), SMALL), COARSE)
    assert result.force[1, 2] < -0.4
    assert not result.wrench[0].any()
    assert not result.wrench[2].any()
    assert not result.traction[2].any()
    assert np.abs(result.surface[2]).max() < 1e-6 * np.abs(result.surface[1]).max()


def test_mirrored_presses_mirror() -> None:
    at = 1e-3, 0.5e-3
    indenter = sphere(3e-3)
    scenes = [
        Scene(indenter, press([0.6e-3], at=(x, y)), SMALL)
        for x, y in ((at[0], at[1]), (-at[0], at[1]), (at[0], -at[1]), (at[1], at[0]))
    ]
    here, x_mirror, y_mirror, swapped = _results(scenes, EXACT)
    force, depth = here.force[-1], 0.6e-3
    assert abs(force[0]) > 0.001, "beside the middle the press has a side force"
    assert x_mirror.force[-1] == pytest.approx(force * [-1, 1, 1], rel=1e-6, abs=1e-9)
    assert y_mirror.force[-1] == pytest.approx(force * [1, -1, 1], rel=1e-6, abs=1e-9)
    assert swapped.force[-1] == pytest.approx(force[[1, 0, 2]], rel=1e-6, abs=1e-9)
    surface = here.surface[-1]
    for other in (
        x_mirror.surface[-1, ::-1] * [-1, 1, 1],
        y_mirror.surface[-1, :, ::-1] * [1, -1, 1],
        swapped.surface[-1].swapaxes(0, 1)[..., [1, 0, 2]],
    ):
        assert np.abs(other - surface).max() < 1e-6 * depth


@pytest.mark.parametrize("effects", few([Effects(friction=Friction(0.5)), Effects()], 1))
def test_a_batch_gives_what_its_scenes_give_alone_bit_for_bit(effects: Effects) -> None:
    """Different indenters, motions, lengths of motion and materials in one batch."""
    soft = Body(size_x=8e-3, size_y=8e-3, thickness=4e-3, modulus=3e4, poisson=0.3)
    scenes = [
        Scene(sphere(3e-3), press([0.3e-3, 0.6e-3]), SMALL, effects),
        Scene(flat_punch(1.5e-3, 0.6e-3), press([0.2e-3], at=(1e-3, 0.0)), soft, effects),
        Scene(named("torus"), press([0.1e-3, 0.2e-3, 0.1e-3]), SMALL, effects),
    ]
    for scene, batched in zip(scenes, _results(scenes, COARSE), strict=True):
        alone = _arrays(simulate(scene, COARSE))
        for name, array in _arrays(batched).items():
            np.testing.assert_array_equal(array, alone[name], err_msg=name)


def test_torque_is_about_the_tip_and_traction_adds_up_to_the_force() -> None:
    result = simulate(Scene(sphere(3e-3), press([0.6e-3], at=(0.5e-3, 0.0)), SMALL), EXACT)
    sides = [
        np.convolve(np.diff(axis), [0.5, 0.5]) for axis in (result.surface_x, result.surface_y)
    ]
    area = np.outer(*sides)
    total = (result.traction[-1].astype(float) * area[..., None]).sum((0, 1))
    assert total == pytest.approx(result.force[-1], rel=1e-5, abs=1e-8)
    # A smooth sphere's force acts through its centre, one radius above the tip.
    torque = np.cross([0, 0, 3e-3], result.force[-1])
    assert result.wrench[-1, 3:] == pytest.approx(torque, abs=2e-3 * np.abs(torque).max())


@pytest.mark.slow
def test_force_scales_with_modulus_and_squared_size_and_mass_counts_in_a_fast_press_alone() -> None:
    def force(modulus: float = 1e5, size: float = 1.0, speed: float = 1e-3, **more: Any) -> float:
        body = Body(8e-3 * size, 8e-3 * size, 4e-3 * size, modulus=modulus)
        motion = press([0.5e-3 * size], speed=speed)
        scene = Scene(sphere(3e-3 * size), motion, body, Effects(**more))
        return float(simulate(scene, replace(EXACT, spacing=4e-3 * size / 3)).force[-1, 2])

    reference = force()
    assert force(modulus=1e7) == pytest.approx(100 * reference, rel=1e-9)
    assert force(size=10.0) == pytest.approx(100 * reference, rel=1e-9)
    assert force(inertia=Inertia()) == pytest.approx(reference, rel=1e-5)
    # 10 m/s is 0.4 of the speed of pressure waves: the body cannot yield.
    assert force(speed=10.0, inertia=Inertia()) < 1.1 * reference < 0
