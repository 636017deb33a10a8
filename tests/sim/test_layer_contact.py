"""Frictionless contact of the layer against exact solutions."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import nnls

from benchmarks.independent.linear_layer import LinearLayer, layer_punch, layer_sphere
from sim.indenters import flat_punch, named, plane, sphere
from sim.layer import Layer
from sim.layer import solver as press_module
from sim.layer.contact import Problem, descend, solve_frictionless
from sim.layer.solver import simulate_layer
from sim.layer.spectral import Convolutions, PixelGrid
from sim.result import Result
from sim.scene import Body, Scene, press
from tests.support.few import few

DEPTHS = (0.5e-3, 1.0e-3, 1.5e-3)
OFF_GRID = (0.13e-3, -0.21e-3)


def _pressed(
    radius: float, at: tuple[float, float] = (0.0, 0.0), poisson: float = 0.45, grid: int = 128
) -> Result:
    body = Body(poisson=poisson)
    return simulate_layer(Scene(sphere(radius), press(DEPTHS, at=at), body=body), Layer(grid=grid))


@functools.cache
def _exact(radius: float, poisson: float = 0.45) -> list[float]:
    body = Body()
    return [
        layer_sphere(depth, radius, LinearLayer(body.thickness, body.modulus, poisson)).force
        for depth in DEPTHS
    ]


@pytest.mark.parametrize("radius", few([2e-3, 4e-3, 10e-3], 1))
@pytest.mark.parametrize("at", [(0.0, 0.0), OFF_GRID, (-2.071e-3, 1.337e-3)])
def test_forces_are_exact_to_a_thousandth_wherever_the_sphere_is(
    radius: float, at: tuple[float, float]
) -> None:
    np.testing.assert_allclose(-_pressed(radius, at).force[1:, 2], _exact(radius), rtol=1e-3)


@pytest.mark.parametrize("poisson", few([0.4999, 0.3, 0.0], 1))
def test_forces_are_exact_for_any_poisson_ratio(poisson: float) -> None:
    exact = _exact(4e-3, poisson)
    np.testing.assert_allclose(-_pressed(4e-3, OFF_GRID, poisson).force[1:, 2], exact, rtol=1e-3)


def test_the_skin_rises_beside_the_contact_as_it_should() -> None:
    result = _pressed(4e-3)
    body = result.scene.body
    exact = layer_sphere(DEPTHS[-1], 4e-3, LinearLayer(body.thickness, body.modulus, body.poisson))
    row = np.argmin(np.abs(result.surface_y))
    distance = np.hypot(result.surface_x, result.surface_y[row])
    beside = (distance > 3.2e-3) & (distance < 8e-3)
    expected = exact.displacement(distance[beside])
    assert expected.max() > 30e-6
    np.testing.assert_allclose(result.surface[-1, beside, row, 2], expected, atol=0.3e-6)


def test_a_sharp_punch_is_right_to_two_hundredths_and_better_with_a_finer_grid() -> None:
    body = Body()
    exact = layer_punch(0.1e-3, 3e-3, LinearLayer(body.thickness, body.modulus, body.poisson)).force
    errors = []
    for grid in (128, 256):
        result = simulate_layer(
            Scene(flat_punch(3e-3), press([0.1e-3], at=OFF_GRID)), Layer(grid=grid)
        )
        errors.append(abs(-result.force[-1, 2] / exact - 1))
    assert errors[0] < 0.02
    assert errors[1] < 0.6 * errors[0]


def test_descent_finds_the_same_pressure_as_an_active_set_method() -> None:
    body = Convolutions(PixelGrid(Body(), 32)).within((8, 16))
    count = 8 * 16
    columns = np.eye(count).reshape(count, 8, 16)
    matrix = np.stack([body.answer.normal(column).ravel() for column in columns], axis=1)
    gap = np.random.default_rng(0).normal(size=(8, 16)) * 1e-4
    # The minimum of p.A p / 2 + g.p over p >= 0, as a least-squares problem.
    root = np.linalg.cholesky(matrix).T
    expected, _ = nnls(root, -np.linalg.solve(root.T, gap.ravel()))
    found = solve_frictionless(body, gap, np.zeros((3, 8, 16)), tolerance=1e-9)
    np.testing.assert_allclose(-found.traction[2].ravel(), expected, atol=1e-6 * expected.max())


def test_pixels_either_touch_or_bear_nothing() -> None:
    result = _pressed(4e-3, OFF_GRID)
    pressure = -result.traction[-1, ..., 2].astype(float)
    x, y = result.surface_x[:, None], result.surface_y[None, :]
    across = np.minimum(np.hypot(x - OFF_GRID[0], y - OFF_GRID[1]), 3.9e-3)
    gap = 4e-3 - np.sqrt(4e-3**2 - across**2) - DEPTHS[-1] - result.surface[-1, ..., 2]
    assert pressure.min() == 0
    assert gap.min() > -2e-3 * DEPTHS[-1]
    assert np.abs(gap[pressure > 0]).max() < 2e-3 * DEPTHS[-1]
    assert result.quality.contact.max() < 2e-3


def test_a_mirrored_press_is_a_mirrored_result() -> None:
    one = simulate_layer(Scene(named("prism"), press([1e-3], at=(1e-3, 0.5e-3))), Layer(grid=64))
    other = simulate_layer(Scene(named("prism"), press([1e-3], at=(-1e-3, 0.5e-3))), Layer(grid=64))
    # Both solutions are within the contact's tolerance of one another's mirror image.
    np.testing.assert_allclose(one.force[-1, 2], other.force[-1, 2], rtol=5e-5)
    scale = np.abs(one.surface[-1]).max()
    mirrored = other.surface[-1, ::-1] * np.array([-1, 1, 1])
    np.testing.assert_allclose(one.surface[-1], mirrored, atol=1e-3 * scale)


@pytest.mark.slow
def test_a_dome_under_a_plate_is_a_flat_body_under_a_sphere() -> None:
    body = Body(size_x=12e-3, size_y=12e-3)
    domed = replace(body, dome_radius=40e-3)
    dome = simulate_layer(Scene(plane(), press([0.3e-3]), body=domed), Layer(grid=32))
    flat = simulate_layer(Scene(sphere(40e-3), press([0.3e-3]), body=body), Layer(grid=32))
    np.testing.assert_allclose(dome.force[-1, 2], flat.force[-1, 2], rtol=1e-6)


def test_more_body_around_changes_nothing_within_the_layer() -> None:
    small = simulate_layer(Scene(sphere(4e-3), press([1e-3])), Layer(grid=64))
    wide = Body(size_x=40e-3)
    large = simulate_layer(Scene(sphere(4e-3), press([1e-3]), body=wide), Layer(grid=128))
    assert large.surface.shape[1:3] == (128, 64)
    np.testing.assert_allclose(small.force[-1, 2], large.force[-1, 2], rtol=1e-3)


def test_contact_outside_of_a_window_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    usual = simulate_layer(Scene(named("dots"), press([1.2e-3])), Layer(grid=48))
    # Windows that contain only overlaps of more than half: they have to be widened.
    monkeypatch.setattr(press_module, "BULGE", -0.5)
    found = simulate_layer(Scene(named("dots"), press([1.2e-3])), Layer(grid=48))
    assert found.quality.steps.sum() > usual.quality.steps.sum()
    np.testing.assert_allclose(found.force, usual.force, atol=1e-2 * np.abs(usual.force).max())


def test_work_put_in_is_held_in_the_body() -> None:
    scene = Scene(sphere(4e-3), press(np.linspace(0.05e-3, 1.5e-3, 30)))
    result = simulate_layer(scene, Layer(grid=64))
    assert np.abs(result.quality.energy_gap[-20:]).max() < 5e-3


COMPLIANCE = np.array([1e-4, 2e-4, 5e-4], np.float32)


def _descended(load: float) -> np.ndarray:
    """Return the result of projected descent in single precision."""
    problem = Problem(
        apply=lambda x: COMPLIANCE * x, project=lambda x: np.maximum(x, 0), local=2e-4
    )
    slope = np.full(3, -load, np.float32)
    found = descend(problem, np.zeros(3, np.float32), slope, tolerance=1e-5, iterations=50)
    return found.x


def test_descent_finds_answers_and_divides_by_nothing_where_squares_of_loads_vanish() -> None:
    np.testing.assert_allclose(_descended(1.0), 1 / COMPLIANCE, rtol=1e-4)
    for exponent in range(-18, -30, -1):
        assert (_descended(10.0**exponent) >= 0).all()
