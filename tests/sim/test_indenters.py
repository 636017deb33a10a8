import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from sim.errors import SceneError
from sim.indenters import (
    NAMES,
    Indenter,
    Part,
    bar,
    box,
    cone,
    drawn_name,
    flat_punch,
    indenter_of,
    named,
    plane,
    rounded_cone,
    sphere,
    torus,
    tube,
)
from tests.support.few import few

Array = NDArray[np.float64]

# Areas 0.5 mm above the tip plane [mm^2], measured on the published meshes. Their facets reduce
# radii by up to 0.05 mm, hence areas of round shapes by 0.05 mm times their outline.
AREAS = {
    "sphere": (14.45, 0.6),
    "sphere_s": (8.47, 0.4),
    "hemisphere": (61.8, 0.6),
    "cone": (1.42, 0.03),
    "cylinder": (28.1, 0.3),
    "cylinder_sh": (15.5, 0.2),
    "cylinder_si": (46.4, 0.3),
    "torus": (42.2, 0.3),
    "dotin": (52.4, 0.3),
    "dots": (11.3, 0.6),
    "wave": (82.6, 1.3),
    "prism": (35.0, 0.05),
    "line": (32.0, 0.05),
    "hexagon": (31.8, 0.15),
    "triangle": (10.8, 0.05),
    "pacman": (22.6, 0.25),
    "moon": (19.4, 0.1),
    "random": (15.8, 0.1),
}
# A point of each indenter's lowest part [mm].
TIPS = {
    "cylinder_sh": (3.1, 0.0),
    "torus": (0.0, -3.0),
    "dotin": (3.0, 3.0),
    "dots": (-3.0, 0.0),
    "wave": (-2.2, 5.0),
    "pacman": (-1.0, 0.0),
    "moon": (-2.2, 0.0),
    "random": (1.7, -1.0),
}
MIRRORED_IN_X = sorted(set(NAMES) - {"dots", "wave", "triangle", "pacman", "moon", "random"})
MIRRORED_IN_Y = sorted(set(NAMES) - {"triangle", "random"})


def _cloud(count: int, seed: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    return rng.uniform([-8.5e-3, -8.5e-3, -1e-3], [8.5e-3, 8.5e-3, 3e-3], (count, 3))


def _on_surface(indenter: Indenter, count: int = 3000) -> Array:
    """Return surface points: nearby points moved along the normal onto the surface."""
    points = _cloud(20 * count)
    points = points[np.abs(indenter.distance(points)[0]) < 0.3e-3][:count]
    for _ in range(30):
        gap, normal = indenter.distance(points)
        points = points - gap[:, None] * normal
    return points[np.abs(indenter.distance(points)[0]) < 1e-12]


@pytest.mark.parametrize("name", NAMES)
def test_areas_are_those_of_the_published_meshes(name: str) -> None:
    step = 0.05e-3
    along = np.arange(-9e-3 + step / 2, 9e-3, step)
    x, y = np.meshgrid(along, along)
    gap, _ = named(name, 0.0).distance(np.stack([x, y, np.full_like(x, 0.5e-3)], axis=-1))
    covered = np.clip(0.5 - gap / step, 0, 1)
    area, tolerance = AREAS[name]
    assert covered.sum() * step**2 * 1e6 == pytest.approx(area, abs=tolerance)


@pytest.mark.parametrize("name", few(NAMES, 6))
def test_the_normal_is_the_unit_gradient_of_the_gap_on_the_surface(name: str) -> None:
    indenter = named(name)
    points = _on_surface(indenter)
    assert len(points) > 300
    _, normal = indenter.distance(points)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-12)
    step = 1e-7
    gradient, bend = np.empty_like(points), np.zeros(len(points))
    for axis in range(3):
        shift = np.zeros(3)
        shift[axis] = step
        ahead, normal_ahead = indenter.distance(points + shift)
        behind, normal_behind = indenter.distance(points - shift)
        gradient[:, axis] = (ahead - behind) / (2 * step)
        bend = np.maximum(bend, np.abs(normal_ahead - normal_behind).max(axis=1))
    # Concave corners stay sharp: a finite difference across one is not a gradient.
    smooth = bend < 0.01
    assert smooth.mean() > 0.9
    np.testing.assert_allclose(gradient[smooth], normal[smooth], atol=2e-3)


@pytest.mark.parametrize("name", NAMES)
def test_the_tip_is_at_zero_and_nothing_is_below_it(name: str) -> None:
    indenter = named(name)
    x, y = TIPS.get(name, (0.0, 0.0))
    assert abs(float(indenter.heights(x * 1e-3, y * 1e-3))) < 1e-12
    points = _cloud(5000)
    below = points[points[:, 2] < 0]
    gap, _ = indenter.distance(below)
    assert np.all(gap >= -below[:, 2] * (1 - 1e-9))


LEANING = [named(name).tilted(0.16, -0.21) for name in ("moon", "wave", "cone", "dotin")]


@pytest.mark.parametrize(
    "indenter", [*map(named, NAMES), *LEANING], ids=lambda each: f"{each.name} {each.tilt}"
)
def test_heights_are_where_the_distance_first_becomes_zero(indenter: Indenter) -> None:
    reach = 4e-3 if indenter.tilt == (0.0, 0.0) else 3e-3
    plan = _cloud(400, seed=3)[:, :2]
    heights = indenter.heights(plan[:, 0], plan[:, 1], reach=reach)
    hit = np.isfinite(heights)
    assert hit.any()
    on_surface = np.column_stack([plan[hit], heights[hit]])
    assert np.abs(indenter.distance(on_surface)[0]).max() < 1e-9
    for fraction in np.linspace(0, 0.999, 40):
        below = np.column_stack([plan, fraction * np.where(hit, heights, reach)])
        assert np.all(indenter.distance(below)[0] > -1e-9)


@pytest.mark.parametrize(
    ("name", "mirror"),
    [(name, (-1, 1, 1)) for name in MIRRORED_IN_X] + [(name, (1, -1, 1)) for name in MIRRORED_IN_Y],
)
def test_mirrored_shapes_are_so_exactly(name: str, mirror: tuple[int, int, int]) -> None:
    points = _cloud(2000)
    gap, normal = named(name).distance(points)
    mirrored, mirrored_normal = named(name).distance(points * mirror)
    np.testing.assert_allclose(mirrored, gap, atol=1e-15)
    np.testing.assert_allclose(mirrored_normal * mirror, normal, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_rounding_only_takes_material_away(name: str) -> None:
    points = _cloud(5000)
    sharp, rounded = named(name, 0.0), named(name)
    inside = rounded.distance(points)[0] < -1e-12
    assert np.all(sharp.distance(points)[0][inside] < 0)


@pytest.mark.parametrize("name", few(NAMES, 6))
def test_every_named_indenter_takes_its_largest_edge_radius_and_no_more(name: str) -> None:
    limit = named(name).edge_radius_max
    largest = named(name, limit * (1 - 1e-6))
    along = np.arange(-9e-3, 9e-3, 0.05e-3)
    x, y = np.meshgrid(along, along)
    gap, _ = largest.distance(np.stack([x, y, np.full_like(x, 0.01 * limit)], axis=-1))
    assert np.any(gap < 0)
    with pytest.raises(SceneError, match=f"{name}.edge_radius"):
        named(name, limit * 1.01)


def test_a_single_part_gives_the_true_distance_everywhere() -> None:
    points = _cloud(2000)
    x, y, z = points.T
    radial = np.hypot(x, y)
    ball = np.linalg.norm(points - [0, 0, 4e-3], axis=1) - 4e-3
    np.testing.assert_allclose(sphere(4e-3).distance(points)[0], ball, atol=1e-15)
    ring = np.hypot(radial - 3e-3, z - 1e-3) - 1e-3
    np.testing.assert_allclose(torus(3e-3, 1e-3).distance(points)[0], ring, atol=1e-15)
    np.testing.assert_allclose(plane().distance(points)[0], -z, atol=0)
    side = np.hypot(x, z - 2e-3) - 2e-3
    np.testing.assert_allclose(bar(2e-3, 1.0).distance(points)[0], side, atol=1e-15)


@pytest.mark.parametrize("edge_radius", [0.0, 0.4e-3])
def test_a_box_gives_the_true_distance_outside(edge_radius: float) -> None:
    points = _cloud(5000)
    core = np.abs(points[:, :2]) - np.array([2e-3, 3e-3]) + edge_radius
    beyond = np.column_stack([core, edge_radius - points[:, 2]])
    inner = np.minimum(beyond.max(axis=1), 0)
    true = np.linalg.norm(np.maximum(beyond, 0), axis=1) + inner - edge_radius
    gap, _ = box(4e-3, 6e-3, edge_radius).distance(points)
    np.testing.assert_allclose(gap, true, atol=1e-15)


@pytest.mark.parametrize("half_angle", [0.0, math.radians(20), math.radians(60)])
def test_the_edge_of_a_punch_or_cone_is_an_arc_of_the_edge_radius(half_angle: float) -> None:
    tip, radius = 2e-3, 0.5e-3
    punch = cone(half_angle, tip, radius) if half_angle else flat_punch(tip, radius)
    cosine, sine = math.cos(half_angle), math.sin(half_angle)
    centre = tip - radius * math.sqrt((1 - sine) / (1 + sine)), radius
    # From straight down to the normal of the side.
    angle = np.linspace(-math.pi / 2, -half_angle, 50)
    out, up = np.cos(angle), np.sin(angle)
    assert (out[-1], up[-1]) == pytest.approx((cosine, -sine))
    around = 0.7
    direction = np.column_stack([out * math.cos(around), out * math.sin(around), up])
    middle = np.array([centre[0] * math.cos(around), centre[0] * math.sin(around), centre[1]])
    for away in (-0.1e-3, 0.0, 0.2e-3):
        gap, normal = punch.distance(middle + (radius + away) * direction)
        np.testing.assert_allclose(gap, away, atol=1e-15)
        np.testing.assert_allclose(normal, direction, atol=1e-9)


def test_a_rounded_cone_ends_in_a_sphere() -> None:
    tip = rounded_cone(math.radians(30), 0.4e-3)
    radial = np.linspace(0, 0.4e-3 * math.cos(math.radians(30)), 20)
    expected = 0.4e-3 - np.sqrt(0.4e-3**2 - radial**2)
    np.testing.assert_allclose(tip.heights(radial, 0.0), expected, atol=1e-9)


def test_heights_are_infinite_beside_the_indenter_and_in_its_hole() -> None:
    ring = tube(3e-3, 2e-3)
    assert ring.heights([0.0, 2.5e-3, 3.001e-3], 0.0).tolist() == [math.inf, 0.0, math.inf]


def test_points_keep_their_shape() -> None:
    gap, normal = sphere(1e-3).distance(np.zeros((2, 5, 3)))
    assert gap.shape == (2, 5)
    assert normal.shape == (2, 5, 3)


def test_an_indenter_is_a_value() -> None:
    assert named("moon") == named("moon")
    assert len({named("moon"), named("moon"), named("moon", 0.0)}) == 2


def test_rounding_a_ridge_that_is_the_tip_is_refused_because_it_would_lift_it() -> None:
    roof = (-1e-3, 1e-3, 0.0, 0.0, 0.0, 0.0, 1e-3, 1e-3, 0.0)
    ridge = Indenter("ridge", (Part("side", "path", roof, "union"),))
    assert float(ridge.heights(0.0, 0.0)) == 0
    with pytest.raises(SceneError, match="lowest point"):
        replace(ridge, edge_radius=0.1e-3)


@pytest.mark.slow
def test_drawn_indenters_differ_are_the_same_by_name_and_as_large_as_the_18() -> None:
    drawn = [indenter_of(drawn_name(number)) for number in range(40)]
    assert len({each.parts for each in drawn}) == 40
    assert drawn[17] == indenter_of("drawn-17")
    for each in drawn:
        # The skin touches at height 0, and the body is within reach of a sensor.
        places = np.linspace(-9e-3, 9e-3, 121)
        heights = each.heights(*np.meshgrid(places, places), reach=2e-3)
        touched = np.isfinite(heights) & (heights < 0.3e-3)
        assert heights.min() == pytest.approx(0.0, abs=2e-5)
        assert not touched[[0, -1]].any()
        assert not touched[:, [0, -1]].any()
        assert each.sharpest >= 0.15e-3
    # All kinds occur: round, flat, ring-shaped, with corners, and of several tips.
    assert {each.parts[0].figure for each in drawn} >= {"circle", "half_plane", "band", "path"}
    assert indenter_of("moon", 1e-4) == named("moon", 1e-4)
    with pytest.raises(SceneError, match=r"allowed: .*drawn-0 to drawn-999"):
        indenter_of("drawn-1000")
