"""The gap under an indenter, interpolated from its samples."""

import numpy as np
import pytest

from sim.indenters import box, flat_punch, plane, sphere
from sim.layer.contact import YIELDING, Clearance
from sim.layer.spectral import PixelGrid
from sim.scene import Body, Motion, press

GRID = PixelGrid(Body(), 128)
RADIUS = 4e-3
ASIDE = Motion(tip=((0.3e-3, 0.1e-3, 0.0), (-1e-3, 2e-3, -1e-3)), time=(0.0, 1.0))


def _gap_of_sphere(tip: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    across = np.hypot(GRID.x[:, None] - tip[0], GRID.y[None, :] - tip[1])
    near = across < 0.8 * RADIUS
    return near, RADIUS - np.sqrt(RADIUS**2 - across[near] ** 2) + tip[2]


def test_at_the_first_waypoint_the_gap_is_the_indenter_s_own() -> None:
    near, exact = _gap_of_sphere((0.3e-3, 0.1e-3, -1e-3))
    found, extra = Clearance(sphere(RADIUS), GRID, ASIDE).at(np.array([0.3e-3, 0.1e-3, -1e-3]))
    np.testing.assert_allclose(found[near], exact, atol=1e-12)
    assert not extra[near].any()


@pytest.mark.parametrize("x", [-1e-3, -0.4321e-3, 0.0, 0.287e-3])
@pytest.mark.parametrize("y", [2e-3, 0.777e-3])
def test_in_between_a_sphere_is_read_to_a_fraction_of_a_micrometre(x: float, y: float) -> None:
    clearance = Clearance(sphere(RADIUS), GRID, ASIDE)
    near, exact = _gap_of_sphere((x, y, -0.5e-3))
    found, _ = clearance.at(np.array([x, y, -0.5e-3]))
    # 0.2 um is the cost, at the very tip, of limiting to the values at the cell's corners.
    np.testing.assert_allclose(found[near], exact, atol=0.25e-6)


def test_a_wall_is_where_it_is_and_moves_evenly() -> None:
    radius = 3e-3
    clearance = Clearance(flat_punch(radius), GRID, ASIDE)
    for x, y in np.random.default_rng(0).uniform([-1e-3, 0.1e-3], [0.3e-3, 2e-3], (50, 2)):
        gap, extra = clearance.at(np.array([x, y, -1e-4]))
        assert gap.min() == pytest.approx(-1e-4, abs=1e-12)
        covered = np.where(gap < 0, 1 / (1 + extra / YIELDING), 0.0)
        assert covered.sum() * GRID.area == pytest.approx(np.pi * radius**2, rel=3e-3)


def test_a_leaning_wall_is_not_pressed() -> None:
    clearance = Clearance(box(3e-3, 5e-3).tilted(0.02, 0.01), GRID, ASIDE)
    gap, extra = clearance.at(np.array([0.1e-3, 0.2e-3, -0.2e-3]))
    covered = np.where(gap < 1e-4, 1 / (1 + extra / YIELDING), 0.0)
    assert covered.sum() * GRID.area == pytest.approx(15e-6, rel=0.02)


def test_a_dome_is_nearest_at_its_apex() -> None:
    dome = PixelGrid(Body(size_x=12e-3, size_y=12e-3, dome_radius=30e-3), 64)
    gap, _ = Clearance(plane(), dome, press([1e-3])).at(np.array([0.0, 0.0, -1e-3]))
    expected = 30e-3 - np.sqrt(30e-3**2 - dome.x[:, None] ** 2 - dome.y[None, :] ** 2) - 1e-3
    np.testing.assert_allclose(gap, expected, atol=1e-12)
