"""The displacement field that signals are computed from: interpolation, rotation, slopes."""

import numpy as np
from numpy.typing import NDArray

from sim.scene import Body
from sim.sensors.field import SurfaceField, cubic_weights, outward_normals

Array = NDArray[np.float64]

X = np.concatenate([np.linspace(-10e-3, -3e-3, 8), np.linspace(-2.4e-3, 10e-3, 22)])
Y = np.linspace(-8e-3, 8e-3, 25)


def field_of(function: object) -> SurfaceField:
    across, along = np.meshgrid(X, Y, indexing="ij")
    values = np.stack(np.broadcast_arrays(*function(across, along)), axis=-1)  # type: ignore[operator]
    return SurfaceField(X, Y, values[None].astype(np.float32))


def bump(x: Array, y: Array) -> tuple[Array, Array, Array]:
    bell = np.exp(-((x - 1e-3) ** 2 + (y + 2e-3) ** 2) / 3e-3**2)
    return 40.0 * x * bell * 1e-3, -30.0 * y * bell * 1e-3, -1e-3 * bell


def test_interpolation_is_exact_for_parabolas_near_by_and_goes_on_beyond_the_edge() -> None:
    wanted = np.linspace(X[0], X[-1], 71)
    weights = cubic_weights(X, wanted)
    for power in range(3):
        np.testing.assert_allclose(weights @ (1e3 * X) ** power, (1e3 * wanted) ** power, atol=1e-9)
    beyond = cubic_weights(X, np.array([-1.0, 1.0]))
    np.testing.assert_allclose(beyond, np.eye(len(X))[[0, -1]], atol=1e-12)
    # A value reaches no further than two intervals.
    places = np.linspace(0, 8, 200)
    far = np.abs(places[:, None] - np.arange(9.0)) >= 2
    assert np.abs(cubic_weights(np.arange(9.0), places))[far].max() < 1e-12


def test_points_and_grids_are_interpolated_alike() -> None:
    field = field_of(bump)
    x, y = np.linspace(-5e-3, 5e-3, 11), np.linspace(-4e-3, 4e-3, 9)
    grid = field.resampled(x, y).displacement[0]
    places = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(field.at(places)[0].reshape(grid.shape), grid, atol=1e-9)


def test_a_turned_field_is_the_same_one_seen_from_a_turned_frame() -> None:
    angle = 0.05
    turned = field_of(bump).turned(angle)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    places = np.random.default_rng(1).uniform(-6e-3, 6e-3, (50, 2))
    there = np.stack(bump(*(places @ turn.T).T), axis=-1)
    expected = np.concatenate([there[:, :2] @ turn, there[:, 2:]], axis=1)
    np.testing.assert_allclose(turned.at(places)[0], expected, atol=2e-6)
    assert turned.turned(0.0) is turned


def test_a_shift_moves_the_whole_top() -> None:
    field = field_of(bump)
    change = field.crept(np.array([3e-6, -2e-6])).displacement - field.displacement
    np.testing.assert_allclose(change, np.broadcast_to([3e-6, -2e-6, 0], change.shape), atol=1e-9)


def test_normals_follow_a_plane_of_any_slope_and_a_turn_of_a_right_angle() -> None:
    slope = np.array([0.7, -1.3])
    tilted = field_of(lambda x, y: (0 * x, 0 * y, slope[0] * x + slope[1] * y))
    upright = field_of(lambda x, y: (-x, 0 * y, x))
    for field, normal in (
        (tilted, np.append(-slope, 1.0) / np.sqrt(1 + slope @ slope)),
        (upright, np.array([-1.0, 0, 0])),
    ):
        found = outward_normals(field)[0]
        np.testing.assert_allclose(found, np.broadcast_to(normal, found.shape), atol=1e-5)


def test_an_undeformed_top_does_not_move() -> None:
    still = SurfaceField.undeformed(Body(size_x=30e-3))
    assert (still.x[0], still.x[-1], still.y[-1]) == (-15e-3, 15e-3, 10e-3)
    assert len(still) == 1
    assert not still.displacement.any()
