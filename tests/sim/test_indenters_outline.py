import math

import numpy as np
import pytest
from numpy.typing import NDArray

from sim.errors import SceneError
from sim.indenters import named
from sim.indenters.outline import OutlinePiece, distance, extent, pieces, radius_max, rows
from sim.indenters.shapes import bulge
from tests.support.few import few

Array = NDArray[np.float64]

OUTLINES = ("hexagon", "triangle", "pacman", "moon", "random", "wave")
SQUARE = (0.0, 0.0, 0.0, 4e-3, 0.0, 0.0, 4e-3, 4e-3, 0.0, 0.0, 4e-3, 0.0)


def _values(name: str) -> tuple[float, ...]:
    return named(name).parts[0].values


def _polygon(values: tuple[float, ...], count: int = 2000) -> Array:
    """Return the path as a fine polygon, its arcs divided by turning about their centres."""
    points = []
    for piece in pieces(values):
        fraction = np.arange(count)[:, None] / count
        start, end = np.array(piece.start), np.array(piece.end)
        if piece.bulge == 0:
            points.append(start + fraction * (end - start))
            continue
        arm, turn = start - piece.centre, fraction[:, 0] * piece.angle
        u = np.cos(turn) * arm[0] - np.sin(turn) * arm[1]
        v = np.sin(turn) * arm[0] + np.cos(turn) * arm[1]
        points.append(np.stack([u, v], axis=1) + piece.centre)
    return np.concatenate(points)


def _polygon_distance(polygon: Array, points: Array) -> Array:
    """Return the distance by brute force over edges; the sign by counting ray crossings."""
    start, end = polygon, np.roll(polygon, -1, axis=0)
    along = end - start
    result = np.empty(len(points))
    for index, point in enumerate(points):
        offset = point - start
        fraction = np.clip((offset * along).sum(1) / (along * along).sum(1), 0, 1)
        nearest = np.linalg.norm(offset - fraction[:, None] * along, axis=1).min()
        straddles = (start[:, 1] > point[1]) != (end[:, 1] > point[1])
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = start[:, 0] + (point[1] - start[:, 1]) / along[:, 1] * along[:, 0]
        inside = np.count_nonzero(straddles & (crossing > point[0])) % 2
        result[index] = -nearest if inside else nearest
    return result


def _cloud(values: tuple[float, ...], count: int) -> Array:
    (low_u, high_u), (low_v, high_v) = extent(values, 0.0)
    rng = np.random.default_rng(1)
    margin = 1e-3
    low, high = (low_u - margin, low_v - margin), (high_u + margin, high_v + margin)
    return rng.uniform(low, high, (count, 2))


def _gap(values: tuple[float, ...], radius: float, points: Array) -> Array:
    return distance(rows(values, radius), points[:, 0], points[:, 1])[0]


@pytest.mark.parametrize("name", few(OUTLINES, 2))
def test_the_distance_is_that_of_a_fine_polygon(name: str) -> None:
    values = _values(name)
    points = _cloud(values, 300)
    polygon = _polygon(values)
    # A chord is radius * (1 - cos(half its angle)) inside its arc: at most 3e-9 m here.
    expected = _polygon_distance(polygon, points)
    np.testing.assert_allclose(_gap(values, 0.0, points), expected, atol=1e-8)


@pytest.mark.parametrize("name", OUTLINES)
def test_rounding_keeps_exactly_what_a_disc_of_that_radius_can_cover(name: str) -> None:
    # Definition of an opening: the union of all discs that fit into the sharp outline.
    values = _values(name)
    radius = 0.8 * min(radius_max(values), 1e-3)
    points = _cloud(values, 3000)
    sharp = _gap(values, 0.0, points)
    table = rows(values, radius)
    gap, normal_u, normal_v = distance(table, points[:, 0], points[:, 1])
    fits = sharp < -radius
    assert np.all(gap[fits] <= -radius)
    assert np.all(gap >= sharp - 1e-15)
    boundary = points - gap[:, None] * np.stack([normal_u, normal_v], axis=1)
    on_it, out_u, out_v = distance(table, boundary[:, 0], boundary[:, 1])
    assert np.abs(on_it).max() < 1e-12
    centres = boundary - radius * np.stack([out_u, out_v], axis=1)
    inside = _gap(values, 0.0, centres)
    # Concave corners stay sharp, and a disc cannot reach into them.
    reachable = np.abs(_gap(values, radius, centres) + radius) < 1e-9
    assert reachable.mean() > 0.8
    assert np.all(inside[reachable] <= -radius + 1e-9)


@pytest.mark.parametrize("name", OUTLINES)
def test_the_extent_is_that_of_the_polygon(name: str) -> None:
    polygon = _polygon(_values(name))
    (low_u, high_u), (low_v, high_v) = extent(_values(name), 0.0)
    np.testing.assert_allclose([low_u, low_v], polygon.min(axis=0), atol=1e-8)
    np.testing.assert_allclose([high_u, high_v], polygon.max(axis=0), atol=1e-8)


def test_a_rounded_square_is_a_smaller_square_grown_by_the_radius() -> None:
    points = np.random.default_rng(2).uniform(-2e-3, 6e-3, (2000, 2))
    core = np.abs(points - 2e-3) - 1.2e-3
    inner = np.minimum(core.max(axis=1), 0)
    expected = np.linalg.norm(np.maximum(core, 0), axis=1) + inner - 0.8e-3
    np.testing.assert_allclose(_gap(SQUARE, 0.8e-3, points), expected, atol=1e-15)


def test_a_square_can_be_rounded_to_a_disc_and_no_further() -> None:
    assert radius_max(SQUARE) == pytest.approx(2e-3, rel=1e-6)
    with pytest.raises(SceneError, match=r"allowed: up to 0\.00"):
        rows(SQUARE, 2.1e-3)


def test_a_path_drawn_clockwise_is_a_hole() -> None:
    hole = (0.0, 0.0, 0.0, 0.0, 4e-3, 0.0, 4e-3, 4e-3, 0.0, 4e-3, 0.0, 0.0)
    points = np.random.default_rng(2).uniform(-2e-3, 6e-3, (500, 2))
    np.testing.assert_allclose(_gap(hole, 0.0, points), -_gap(SQUARE, 0.0, points), atol=1e-15)
    assert extent(hole, 0.0)[0] == (-math.inf, math.inf)


def test_two_half_circles_are_a_disc() -> None:
    disc = (1e-3, 0.0, 1.0, -1e-3, 0.0, 1.0)
    points = np.random.default_rng(4).uniform(-2e-3, 2e-3, (1000, 2))
    gap, normal_u, normal_v = distance(rows(disc, 0.0), points[:, 0], points[:, 1])
    length = np.linalg.norm(points, axis=1)
    np.testing.assert_allclose(gap, length - 1e-3, atol=1e-15)
    np.testing.assert_allclose(
        np.stack([normal_u, normal_v], 1), points / length[:, None], atol=1e-9
    )


def test_points_on_the_path_and_on_its_corners_have_a_unit_normal() -> None:
    values = _values("random")
    for radius in (0.0, 0.3e-3):
        table = rows(values, radius)
        corners = table[table[:, 0] == 2, 1:3]
        gap, normal_u, normal_v = distance(table, corners[:, 0], corners[:, 1])
        assert np.abs(gap).max() < 1e-15
        np.testing.assert_allclose(np.hypot(normal_u, normal_v), 1, atol=1e-12)


def test_the_bulge_of_an_arc_is_found_from_three_of_its_points() -> None:
    for angle in (0.3, 2.0, 5.0, -1.0, -4.0):
        at = [
            (math.cos(fraction * angle), math.sin(fraction * angle)) for fraction in (0.0, 0.3, 1.0)
        ]
        turn = bulge(at[0], at[1], at[2])
        arc = OutlinePiece(at[0], at[2], turn)
        assert turn == pytest.approx(math.tan(angle / 4))
        assert arc.centre == pytest.approx((0, 0), abs=1e-12)
        assert arc.radius == pytest.approx(math.copysign(1, angle))
        assert arc.length == pytest.approx(abs(angle))
        assert arc.fraction(at[1]) == pytest.approx(0.3)
