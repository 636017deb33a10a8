"""Layers solved together, as on a GPU, are those solved one by one."""

import numpy as np
import pytest
from support.devices import DEVICES

from sim.errors import SimulationDiverged
from sim.indenters import flat_punch, named, plane, sphere, torus
from sim.layer import Layer, batch, batch_kernels
from sim.layer.batch import simulate_layers
from sim.layer.solver import simulate_layer
from sim.result import Outcome, Result
from sim.scene import Body, Effects, Friction, Motion, Scene, Viscosity, press

# Its kernels are compiled for a GPU or for the CPU, where one thread solves a press.
GRID = 32
LOOP = press([0.8e-3], shear=0.5e-3, steps=2)
SMOOTH = [
    Scene(sphere(4e-3), press([0.05e-3, 0.4e-3, 1e-3], at=(1e-3, 0.5e-3))),
    Scene(sphere(2.5e-3), press([0.2e-3], at=(-3e-3, 2e-3))),
    Scene(torus(3e-3, 1e-3), press([0.3e-3, 0.1e-3])),
    Scene(plane(), press([0.1e-3])),
    Scene(flat_punch(2e-3, 0.2e-3).tilted(0.05, 0.02), press([0.3e-3, 0.5e-3])),
]


def results(outcomes: list[Outcome]) -> list[Result]:
    """Return the outcomes, all of which must be results."""
    found = [one for one in outcomes if isinstance(one, Result)]
    assert len(found) == len(outcomes)
    return found


def assert_same(one: Result, other: Result, within: float) -> None:
    """Compare two results up to a fraction of the largest force and displacement."""
    largest = np.abs(other.force).max()
    np.testing.assert_allclose(one.force, other.force, atol=within * largest)
    np.testing.assert_allclose(one.wrench[:, 3:], other.wrench[:, 3:], atol=within * largest * 5e-3)
    for mine, its in ((one.surface, other.surface), (one.traction, other.traction)):
        np.testing.assert_allclose(mine, its, atol=10 * within * np.abs(its).max())
    np.testing.assert_allclose(one.quality.energy_gap, other.quality.energy_gap, atol=10 * within)
    assert (one.quality.residual <= one.record["tolerance"]).all()
    pixel = np.diff(other.surface_x).max()
    np.testing.assert_allclose(
        one.quality.contact_width, other.quality.contact_width, atol=1.01 * pixel
    )
    np.testing.assert_array_equal(one.quality.steps, other.quality.steps)


@pytest.mark.parametrize("device", DEVICES)
def test_presses_of_any_length_and_shape_are_those_of_the_single_solver(device: str) -> None:
    layer = Layer(grid=GRID, tolerance=1e-6)
    told: list[float] = []
    found = results(simulate_layers(SMOOTH, layer, device=device, progress=told.append))
    for scene, one in zip(SMOOTH, found, strict=True):
        assert one.scene is scene
        assert_same(one, simulate_layer(scene, layer), 1e-5)
    assert told[-1] == 1.0
    assert told == sorted(told)


@pytest.mark.parametrize("device", DEVICES)
def test_single_precision_is_enough_for_the_default_tolerance(device: str) -> None:
    found = results(simulate_layers(SMOOTH, Layer(grid=GRID), device=device))
    assert found[0].record["precision"] == "float32"
    for scene, one in zip(SMOOTH, found, strict=True):
        exact = simulate_layer(scene, Layer(grid=GRID, tolerance=1e-6))
        np.testing.assert_allclose(one.force, exact.force, atol=1e-3 * np.abs(exact.force).max())


@pytest.mark.parametrize("device", DEVICES)
def test_friction_and_viscosity_are_those_of_the_single_solver(device: str) -> None:
    layer = Layer(grid=GRID, tolerance=1e-5)
    viscosity = Viscosity(ratios=(0.3, 0.0, 0.2), times=(0.1, 1.0, 2.0))
    scenes = [
        Scene(shape, LOOP, effects=Effects(friction=Friction(coefficient), viscosity=viscosity))
        for shape, coefficient in ((sphere(4e-3), 0.5), (named("cylinder"), 1.5))
    ]
    scenes.append(Scene(sphere(3e-3), LOOP, effects=Effects(friction=Friction(0.2))))
    for scene, one in zip(
        scenes, results(simulate_layers(scenes, layer, device=device)), strict=True
    ):
        alone = simulate_layer(scene, layer)
        # Alone, heights between samples are interpolated while the tip slides.
        assert_same(one, alone, 1e-3)
        assert one.quality.slip_excess.max() < 1e-9
        assert one.force[-1].any() == alone.force[-1].any()


def test_a_dome_and_a_sensor_of_other_size_are_solved_beside_each_other() -> None:
    layer = Layer(grid=GRID, tolerance=1e-6)
    bodies = [Body(dome_radius=29e-3), Body(size_x=16e-3, size_y=12e-3, thickness=3e-3)]
    scenes = [Scene(sphere(4e-3), press([0.5e-3]), body=body) for body in bodies]
    for scene, one in zip(
        scenes, results(simulate_layers(scenes, layer, device="cpu")), strict=True
    ):
        assert_same(one, simulate_layer(scene, layer), 1e-5)


def test_a_result_does_not_depend_on_the_presses_beside_it(monkeypatch: pytest.MonkeyPatch) -> None:
    batched = results(simulate_layers(SMOOTH, Layer(grid=GRID), device="cpu"))
    monkeypatch.setattr(batch, "AT_ONCE", 2)
    monkeypatch.setattr(batch, "STAGED", 12 * 1000)  # frames come to the host in many pieces
    apart = results(simulate_layers(SMOOTH, Layer(grid=GRID), device="cpu"))
    for one, other in zip(batched, apart, strict=True):
        np.testing.assert_array_equal(one.force, other.force)
        np.testing.assert_array_equal(one.surface, other.surface)
    assert {one.record["at_once"] for one in apart} == {1, 2}


def test_wide_contacts_on_fine_pixels_are_left_to_the_single_solver(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(batch, "PIXELS_MOST", GRID**2 - 1)
    told: list[float] = []
    layer = Layer(grid=GRID)
    found = results(simulate_layers(SMOOTH, layer, device="cpu", progress=told.append))
    on_plane = SMOOTH.index(next(one for one in SMOOTH if one.indenter.name == "plane"))
    assert ["at_once" in one.record for one in found].index(False) == on_plane
    alone = simulate_layer(SMOOTH[on_plane], layer)
    np.testing.assert_array_equal(found[on_plane].traction, alone.traction)
    assert told[-1] == 1.0


def test_a_press_that_does_not_converge_leaves_the_others_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(batch_kernels, "TURNS", 1)
    batch_kernels.contact_kernel.cache_clear()
    motion = Motion(tip=((0, 0, 0), (0.2e-3, 0, -1e-3)), time=(0.0, 1.0))
    rubs = Effects(friction=Friction(0.8))
    above = Motion(tip=((0, 0, 2e-3), (0, 0, 1e-3)), time=(0.0, 1.0))
    told: list[float] = []
    try:
        failed, free = simulate_layers(
            [Scene(sphere(4e-3), motion, effects=rubs), Scene(sphere(4e-3), above, effects=rubs)],
            Layer(grid=GRID),
            device="cpu",
            progress=told.append,
        )
    finally:
        batch_kernels.contact_kernel.cache_clear()
    assert isinstance(failed, SimulationDiverged)
    assert "no converged state after the tip" in str(failed)
    assert len(failed.tried) == 5
    assert failed.dump is not None
    with np.load(failed.dump) as state:
        assert state["traction"].shape == (3, GRID, GRID)
    failed.forget_dump()
    assert isinstance(free, Result)
    assert not free.force.any()
    assert told[-1] == 1.0
