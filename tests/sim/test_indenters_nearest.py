"""Distances to triangles, on the device and by an independent implementation."""

import numpy as np
import pytest
from numpy.typing import NDArray
from support import stl_files as files
from support.devices import DEVICES

from sim.indenters.nearest import SKIP, Nearest, misplaced_share
from sim.indenters.solid import NodeGrid

Array = NDArray[np.float64]
# A body with a hole, made of long triangles.
TUBE = files.revolved([(3, 0), (3, 4), (2, 4), (2, 0)], 12)


def _nearest(body: files.Body, *, closed: bool, device: str = "cpu") -> Nearest:
    return Nearest(body[0] * 1e-3, body[1].astype(np.int32), closed=closed, device=device)


def _cloud(count: int) -> Array:
    return np.random.default_rng(5).uniform([-4, -4, -1], [4, 4, 5], (count, 3)) * 1e-3


def _oracle(body: files.Body, points: Array) -> tuple[Array, Array]:
    """Return distance to the nearest triangle and winding number of the surface (N,), (N,).

    Nearest: the projection on the plane if it is in the triangle, else on one of its sides.
    Winding: solid angles (Van Oosterom & Strackee 1983) over 4 pi.
    """
    nearest, winding = np.full(len(points), np.inf), np.zeros(len(points))
    for corners in body[0][body[1]] * 1e-3:
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        normal /= np.linalg.norm(normal)
        height = (points - corners[0]) @ normal
        foot = points - height[:, None] * normal
        within = np.ones(len(points), bool)
        for here, there in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            side = there - here
            within &= (foot - here) @ np.cross(normal, side) >= 0
            fraction = np.clip((points - here) @ side / (side @ side), 0, 1)
            away = np.linalg.norm(points - here - fraction[:, None] * side, axis=1)
            nearest = np.minimum(nearest, away)
        nearest = np.where(within, np.minimum(nearest, np.abs(height)), nearest)
        a, b, c = (corner - points for corner in corners)
        la, lb, lc = (np.linalg.norm(arm, axis=1) for arm in (a, b, c))
        over = np.einsum("ij,ij->i", a, np.cross(b, c))
        under = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
        winding += 2 * np.arctan2(over, under) / (4 * np.pi)
    return nearest, winding


@pytest.mark.parametrize("device", DEVICES)
def test_distance_and_side_are_those_worked_out_by_hand(device: str) -> None:
    points = _cloud(2000)
    nearest, winding = _oracle(TUBE, points)
    near = _nearest(TUBE, closed=True, device=device)
    length, along = near.distance(points)
    gap, out = near.signed(points)
    np.testing.assert_allclose(length, nearest, rtol=0, atol=2e-9)
    np.testing.assert_allclose(gap, np.where(winding > 0.5, -nearest, nearest), atol=2e-9)
    assert 200 < (gap < 0).sum() < 1800
    # The gradient points to the surface.
    for distance, direction in ((length, along), (gap, out)):
        np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1, atol=1e-5)
        on_it = points - distance[:, None] * direction
        assert _oracle(TUBE, on_it)[0].max() < 1e-8


def test_on_the_surface_the_direction_is_the_triangles_own() -> None:
    gap, out = _nearest(files.block(2, 2, 2), closed=True).signed(np.array([[0.1e-3, 0.2e-3, 0.0]]))
    assert abs(gap[0]) < 1e-9
    np.testing.assert_allclose(out[0], [0, 0, -1], atol=1e-6)


@pytest.mark.slow
def test_the_nodes_of_a_grid_have_the_signed_distance_near_the_surface_and_its_sign_afar() -> None:
    grid = NodeGrid((-30, -29, -8), (60, 58, 43), 0.15e-3)
    assert any((count - 1) % SKIP for count in grid.shape)
    exact = 0.5e-3
    near = _nearest(TUBE, closed=True)
    found, true = near.signed_at_nodes(grid, exact).ravel(), near.signed(grid.points())[0]
    close = np.abs(true) <= exact
    np.testing.assert_allclose(found[close], true[close], atol=1e-12)
    assert 0.1 < close.mean() < 0.9
    assert np.array_equal(found[~close] < 0, true[~close] < 0)
    # The distance changes at most as fast as the position.
    assert np.abs(found - true).max() < np.sqrt(3) * SKIP * grid.spacing / 2


def test_shells_that_overlap_or_are_inside_out_are_misplaced() -> None:
    one, other = files.block(2, 2, 2), files.moved(files.ball(0.8, 9), [0, 0, 2])

    def fraction(*bodies: files.Body) -> float:
        vertices, faces = files.joined(*bodies)
        return misplaced_share(vertices * 1e-3, faces.astype(np.int32))

    assert fraction(one, files.moved(other, [4, 0, 0])) == 0
    # Half of the ball is inside the block. Part of the block's top is inside the ball, but its two
    # triangles are too coarse to show it: their centroids are outside.
    assert 0.05 < fraction(one, other) < 0.6
    assert fraction(one, (other[0] + [4, 0, 0], other[1][:, ::-1])) > 0.1
    # A cavity is valid.
    bubble = files.moved(files.ball(0.5, 9), [0, 0, 1])
    assert fraction(one, (bubble[0], bubble[1][:, ::-1])) == 0
    assert fraction(one, bubble) > 0.05
