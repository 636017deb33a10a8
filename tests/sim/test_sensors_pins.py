"""Pins under a skin: their tips magnify the slope, stay round, and mirror with the press."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sim.sensors.field import SurfaceField
from sim.sensors.pins import Pins, tip_coverage

Array = NDArray[np.float64]

X = np.linspace(-10e-3, 10e-3, 101)


def skin(u_x: Array, u_y: Array, u_z: Array) -> SurfaceField:
    return SurfaceField(X, X, np.stack([u_x, u_y, u_z], axis=-1)[None].astype(np.float32))


def grid() -> tuple[Array, Array]:
    x, y = np.meshgrid(X, X, indexing="ij")
    return x, y


@pytest.mark.parametrize("slope", [0.01, 0.5, 2.0])
def test_tips_of_a_leaning_skin_are_aside_by_length_times_sine(slope: float) -> None:
    x, y = grid()
    length = 2e-3
    leaning = skin(0 * x, 0 * y, slope * x)
    moved = Pins(length, 1e-3).tips(leaning).at(np.array([[1e-3, 2e-3]]))[0, 0]
    sine, cosine = np.sin(np.arctan(slope)), np.cos(np.arctan(slope))
    expected = [length * sine, 0.0, slope * 1e-3 + length * (1 - cosine)]
    np.testing.assert_allclose(moved, expected, atol=2e-8)


def test_pins_of_no_length_and_no_width_are_the_skin() -> None:
    x, y = grid()
    given = skin(1e-4 * np.sin(x / 3e-3), 0 * y, -5e-4 * np.cos(y / 3e-3))
    places = np.random.default_rng(3).uniform(-8e-3, 8e-3, (30, 2))
    np.testing.assert_allclose(Pins(0.0, 0.0).tips(given).at(places), given.at(places), atol=1e-9)


def test_a_pin_does_not_bend_with_an_edge_narrower_than_itself() -> None:
    x, y = grid()
    kink = skin(0 * x, 0 * y, np.maximum(x, 0.0))
    rigid = Pins(2e-3, 2e-3).tips(kink).at(np.array([[0.0, 0.0]]))[0, 0, 0]
    # Half of the foot is level, half is tilted by 45 degrees: the pin follows the average.
    expected = 2e-3 * np.sin(np.arctan2(np.sin(np.pi / 4) / 2, (1 + np.cos(np.pi / 4)) / 2))
    assert rigid == pytest.approx(expected, rel=0.05)


def test_a_mirrored_skin_mirrors_the_tips() -> None:
    x, y = grid()
    bell = np.exp(-((x - 2e-3) ** 2 + (y - 1e-3) ** 2) / 3e-3**2)
    given = skin(2e-4 * bell, 1e-4 * bell, -1e-3 * bell)
    mirrored = SurfaceField(X, X, (given.displacement[:, ::-1] * [-1, 1, 1]).astype(np.float32))
    pins = Pins(2e-3, 1.2e-3)
    places = np.random.default_rng(4).uniform(-6e-3, 6e-3, (40, 2))
    tips, other = pins.tips(given).at(places), pins.tips(mirrored).at(places * [-1, 1])
    np.testing.assert_allclose(other, tips * [-1, 1, 1], atol=1e-8)


def test_a_tip_covers_its_area_wherever_it_lies_within_a_pixel() -> None:
    centres = np.random.default_rng(5).uniform(20, 60, (50, 1, 2))
    grey = tip_coverage(centres, np.full((50, 1), 7.3), width=80, height=80)
    area = grey.astype(float).sum(axis=(1, 2)) / 255
    np.testing.assert_allclose(area, np.pi * 7.3**2, rtol=5e-3)
    rows, columns = np.mgrid[:80, :80]
    middle = np.stack(
        [(grey * each).sum(axis=(1, 2)) / grey.sum(axis=(1, 2)) for each in (columns, rows)], axis=1
    )
    np.testing.assert_allclose(middle, centres[:, 0], atol=0.02)


def test_tips_at_and_beyond_the_border_are_cut() -> None:
    centres = np.array([[[0.0, 10.0], [-30.0, 10.0], [39.0, -2.0], [500.0, 500.0]]])
    grey = tip_coverage(centres, np.full((1, 4), 5.0), width=40, height=30)
    whole = tip_coverage(np.array([[[20.0, 10.0]]]), np.full((1, 1), 5.0), width=40, height=30)
    np.testing.assert_array_equal(grey[0, :, :6], whole[0, :, 20:26])
    assert grey[0, :, 10:30].max() == 0
