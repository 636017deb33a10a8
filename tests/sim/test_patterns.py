"""Patterns: their markers, and signed distances that agree with geometry."""

import math

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from sim.errors import SceneError
from sim.markers import (
    HOMOGENEOUS,
    NAMES,
    SIMULATED,
    Pattern,
    Textures,
    hexagon,
    named,
    rings,
    staggered,
)
from sim.scene import Body

COUNTS = {
    "Array": (225, 100, 80, 99),
    "Circle": (320, 115, 111, 124),
    "Diamond": (245, 100, 81, 81),
}


def test_patterns_have_the_published_number_of_markers() -> None:
    for kind, counts in COUNTS.items():
        assert tuple(len(named(f"{kind}{index}")) for index in (1, 2, 3, 4)) == counts
    assert len(SIMULATED) == 12
    assert HOMOGENEOUS == ("Array-I", "Array-II", "Circle-I", "Circle-II", "Diamond-I")
    assert (len(named("GelSight")), len(named("TacPalm"))) == (56, 127)


@pytest.mark.parametrize("name", NAMES)
def test_markers_are_a_quarter_to_half_as_wide_as_apart_and_lie_on_the_papers_gel(
    name: str,
) -> None:
    pattern = named(name)
    apart = cKDTree(pattern.centres).query(pattern.centres, k=2)[0][:, 1]
    assert apart.min() > 0
    assert 0.25 <= pattern.size / np.median(apart) <= 0.45
    if name != "TacPalm":
        pattern.check_within(Body())
        return
    with pytest.raises(SceneError, match=r"'TacPalm'.*beyond the gel.*20 x 20 mm"):
        Textures([pattern], Body())


@pytest.mark.parametrize("kind", ["Array", "Circle"])
def test_the_second_gelsight_is_the_first_one_moved_and_turned(kind: str) -> None:
    first, second = named(f"{kind}-I"), named(f"{kind}-II")
    apart = [np.linalg.norm(np.diff(p.centres, axis=0), axis=1) for p in (first, second)]
    np.testing.assert_allclose(*apart, rtol=1e-12)
    far = np.linalg.norm(first.centres - second.centres, axis=1)
    assert 0.3e-3 < far.max() < 1.5e-3
    # About the middle, and then it shifts.
    moved = Pattern("one", "square", 1e-3, ((2e-3, 0.0),)).moved((1e-3, 0.0), math.pi / 2)
    assert moved.centres[0] == pytest.approx((1e-3, 2e-3))
    assert moved.angle == pytest.approx(math.pi / 2)


def test_layouts_count_as_they_say() -> None:
    assert [len(hexagon(count, 1.0)) for count in (0, 1, 2, 6)] == [1, 7, 19, 127]
    assert len(rings((6, 12), 1.0, middle=True)) == 19
    radii = np.hypot(*np.array(rings((5, 9), 2.0, middle=False)).T)
    assert sorted(np.round(radii, 9).tolist()) == [2.0] * 5 + [4.0] * 9
    assert len(staggered(5, 3, 1.0, 1.0, shorter=True)) == 14
    assert len(staggered(5, 3, 1.0, 1.0, shorter=False)) == 15


def outline(pattern: Pattern, count: int) -> np.ndarray:
    """Return points on the edges of all markers, evenly spaced along each."""
    turn = 2 * np.pi * np.arange(count) / count
    if pattern.shape == "disc":
        edge = pattern.size / 2 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    else:
        start = pattern.angle + (0 if pattern.shape == "diamond" else np.pi / 4)
        half = pattern.size / 2 * (1 if pattern.shape == "diamond" else np.sqrt(2))
        corner = half * np.exp(1j * (start + np.pi / 2 * np.arange(5)))
        fraction = np.linspace(0, 1, count // 4, endpoint=False)[:, None]
        sides = (corner[:4] * (1 - fraction) + corner[1:] * fraction).T.ravel()
        edge = np.stack([sides.real, sides.imag], axis=1)
    return (pattern.centres[:, None] + edge).reshape(-1, 2)


@pytest.mark.parametrize(
    "pattern",
    [
        named("Circle4"),
        named("Diamond4"),
        named("Array4").moved((0.2e-3, 0.1e-3), 0.3),
        named("Diamond3").moved((0.0, 0.1e-3), -0.05),
    ],
    ids=lambda pattern: pattern.shape,
)
def test_distance_is_that_to_the_nearest_point_of_an_outline(pattern: Pattern) -> None:
    x = np.linspace(-3e-3, 3e-3, 61)
    y = np.linspace(-2.5e-3, 3e-3, 53)
    band = 0.4e-3
    found = pattern.distance(x, y, band)
    points = np.stack(np.meshgrid(x, y), axis=-1)
    size = cKDTree(outline(pattern, 1600)).query(points)[0]
    np.testing.assert_allclose(
        np.abs(found), np.minimum(size, np.where(found < 0, 1, band)), atol=2e-6
    )
    assert pattern.marker_distance(np.zeros(2)) == pytest.approx(found.min(), abs=0.1e-3)


def test_inside_is_negative_and_covers_the_area_of_the_markers() -> None:
    x = np.linspace(-10e-3, 10e-3, 2001)
    pixel = float(x[1] - x[0]) ** 2
    for shape, area in (("disc", math.pi / 4), ("square", 1.0), ("diamond", 0.5)):
        pattern = Pattern("one", shape, 1e-3, ((0.0, 0.0), (3e-3, -2e-3)))  # type: ignore[arg-type]
        fraction = np.clip(0.5 - pattern.distance(x, x, 0.1e-3) / 10e-6, 0, 1)
        assert fraction.sum() * pixel == pytest.approx(2 * area * 1e-6, rel=2e-3)


def test_a_texture_read_in_between_is_within_a_micrometre() -> None:
    pattern = named("Circle1")
    texture = Textures([pattern], Body())
    points = np.random.default_rng(1).uniform(-9.9e-3, 9.9e-3, (20000, 2))
    index = (points - texture.corner)[:, ::-1].T / texture.step
    read = map_coordinates(texture.values.numpy()[0], index, order=1)
    exact = cKDTree(pattern.centres).query(points)[0] - pattern.size / 2
    near = np.abs(exact) < 0.12e-3
    assert np.abs(read - exact)[near].max() < 1e-6
    assert np.abs(read - exact)[np.abs(exact) < 30e-6].max() < 0.4e-6


def test_textures_reach_from_border_to_border_and_lie_symmetrically() -> None:
    texture = Textures([named("Array1")], Body(size_x=19.999e-3, size_y=20e-3), step=30e-6)
    (values,) = texture.values.numpy()
    rows, columns = values.shape
    assert texture.corner == pytest.approx(
        (-(columns - 1) / 2 * texture.step, -(rows - 1) / 2 * texture.step)
    )
    assert texture.corner[0] <= -9.9995e-3
    np.testing.assert_allclose(values, values[::-1, ::-1], atol=1e-9)
