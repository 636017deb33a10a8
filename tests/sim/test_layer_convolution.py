"""Convolutions with the layer's compliance, against explicit sums and point loads."""

import numpy as np
import pytest
from support.closed_forms import boussinesq, cerruti

from sim.layer.spectral import Convolutions, PixelGrid
from sim.scene import Body


def test_a_window_gives_what_the_whole_top_gives() -> None:
    grid = PixelGrid(Body(), 48)
    convolutions = Convolutions(grid)
    random = np.random.default_rng(0)
    traction = np.zeros((3, *grid.shape))
    window = (slice(None), slice(11, 27), slice(20, 28))
    traction[window] = random.normal(size=(3, 16, 8))
    whole = convolutions.whole.full(traction.astype(np.float32))
    within = convolutions.within((16, 8)).answer.full(traction[window])
    np.testing.assert_allclose(whole[window], within, atol=2e-6 * np.abs(within).max())


def test_parts_add_up_to_the_whole_answer() -> None:
    body = Convolutions(PixelGrid(Body(), 32)).within((8, 16)).answer
    traction = np.random.default_rng(1).normal(size=(3, 8, 16))
    full = body.full(traction)
    in_plane = body.shear(traction[:2]) + body.shear_by_normal(traction[2])
    upright = body.normal_by_shear(traction[:2]) + body.normal(traction[2])
    np.testing.assert_allclose(full[:2], in_plane, atol=1e-12 * np.abs(full).max())
    np.testing.assert_allclose(full[2], upright, atol=1e-12 * np.abs(full).max())


@pytest.mark.parametrize("axis", [1, 2])
def test_a_mirrored_load_has_a_mirrored_answer(axis: int) -> None:
    body = Convolutions(PixelGrid(Body(poisson=0.2), 32)).within((32, 32)).answer
    traction = np.random.default_rng(3).normal(size=(3, 32, 32))
    turned = np.ones((3, 1, 1))
    turned[axis - 1] = -1
    moved = body.full(traction)
    mirrored = turned * np.flip(body.full(turned * np.flip(traction, axis)), axis)
    np.testing.assert_allclose(moved, mirrored, atol=1e-12 * np.abs(moved).max())


def test_work_is_the_same_whichever_load_comes_first() -> None:
    body = Convolutions(PixelGrid(Body(poisson=0.2), 32)).within((16, 8)).answer
    one, other = np.random.default_rng(2).normal(size=(2, 3, 16, 8))
    assert np.vdot(one, body.full(other)) == pytest.approx(np.vdot(other, body.full(one)))
    assert np.vdot(one, body.full(one)) > 0


def test_a_pixel_s_own_displacement_is_what_a_load_on_it_gives() -> None:
    elastic = Convolutions(PixelGrid(Body(), 32)).within((8, 8))
    load = np.zeros((3, 8, 8))
    load[2, 3, 4] = 1
    assert elastic.answer.full(load)[2, 3, 4] == pytest.approx(elastic.local_normal)
    load = np.roll(load, 1, axis=0)
    assert elastic.answer.full(load)[0, 3, 4] == pytest.approx(elastic.local_shear)


@pytest.mark.parametrize("poisson", [0.0, 0.45])
def test_near_a_small_load_a_thick_layer_moves_like_a_half_space(poisson: float) -> None:
    grid = PixelGrid(Body(thickness=40e-3, poisson=poisson), 64)
    x, y = np.meshgrid(grid.x, grid.y, indexing="ij")
    spread = np.exp(-(x**2 + y**2) / (2 * (1.5 * grid.pixel[0]) ** 2))
    force = 0.7
    load = spread / spread.sum() * force / grid.area
    modulus = grid.body.modulus
    far = (np.hypot(x, y) > 3e-3) & (np.hypot(x, y) < 5e-3)
    for axis in range(3):
        traction = np.zeros((3, *grid.shape), np.float32)
        traction[axis] = load
        found = Convolutions(grid).whole.full(traction)[:, far].astype(float)
        if axis == 2:
            exact = boussinesq(x[far], y[far], force, modulus, poisson).T
        else:
            along, aside = (x[far], y[far]) if axis == 0 else (y[far], x[far])
            exact = cerruti(along, aside, force, modulus, poisson).T
            exact = exact if axis == 0 else exact[[1, 0, 2]]
        # The base, ten distances below, reduces the displacement of the neighbourhood uniformly.
        difference = found - exact
        difference -= difference.mean(axis=1, keepdims=True)
        assert np.abs(difference).max() < 0.02 * np.abs(exact).max()


def test_pixels_of_a_long_body_are_square() -> None:
    grid = PixelGrid(Body(size_x=30e-3, size_y=10e-3), 96)
    assert grid.shape == (96, 32)
    assert grid.pixel[0] == pytest.approx(grid.pixel[1])
