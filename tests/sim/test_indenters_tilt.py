"""Tilted indenters."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from support import stl_files as files

from sim.indenters import NAMES, Indenter, bar, box, flat_punch, from_stl, named, sphere
from sim.result import from_json, to_json
from sim.scene import Scene, press
from tests.support.few import few

Array = NDArray[np.float64]

# 15 degrees in total, with different parts about x and y.
TILT = math.radians(9), math.radians(-12)
# Every kind of part; the other indenters are slow tests.
QUICK = ("sphere", "cone", "cylinder_si", "torus", "dots", "wave", "line", "moon")


def _cloud(count: int, seed: int = 0) -> Array:
    low, high = [-9e-3, -9e-3, -1e-3], [9e-3, 9e-3, 4e-3]
    return np.random.default_rng(seed).uniform(low, high, (count, 3))


def _turn(tilt: tuple[float, float] = TILT) -> Array:
    return Rotation.from_rotvec([*tilt, 0]).as_matrix()


def test_a_tilted_sphere_is_a_sphere() -> None:
    radius, points = 4e-3, _cloud(2000)
    found, normal = sphere(radius).tilted(*TILT).distance(points)
    centre = _turn() @ [0, 0, radius]
    away = points - [centre[0], centre[1], radius]
    length = np.linalg.norm(away, axis=1)
    np.testing.assert_allclose(found, length - radius, atol=1e-15)
    np.testing.assert_allclose(normal, away / length[:, None], atol=1e-9)


@pytest.mark.parametrize("angle", [math.radians(15), 1e-4])
@pytest.mark.parametrize("edge", few([0.4e-3, 0.0], 1))
def test_a_tilted_punch_stands_on_its_rim(edge: float, angle: float) -> None:
    radius = 3e-3
    punch = flat_punch(radius, edge).tilted(0.0, angle)
    # The lowest point of the rim's arc is straight below its centre.
    drop = (radius - edge) * math.sin(angle) + edge * (1 - math.cos(angle))
    assert punch.stance[1] == pytest.approx(drop, abs=5e-9)
    foot = (radius - edge) * math.cos(angle) + edge * math.sin(angle)
    assert abs(float(punch.heights(foot, 0.0))) < 5e-9
    assert abs(punch.distance([foot, 0.0, 0.0])[0]) < 5e-9


def test_a_tilted_box_stands_on_a_corner() -> None:
    corners = np.array([(x, y, 0) for x in (-2e-3, 2e-3) for y in (-3e-3, 3e-3)])
    lowest = (corners @ _turn().T)[:, 2].min()
    assert box(4e-3, 6e-3).tilted(*TILT).stance[1] == pytest.approx(-lowest, abs=1e-12)
    # A round bar along y rolls about y; tilted about x, it rests on the end of its lowest line.
    radius, length = 3e-3, 14e-3
    rolled = bar(radius, length).tilted(0.0, 0.2)
    assert rolled.stance[1] == pytest.approx(radius * (1 - math.cos(0.2)), abs=1e-9)
    on_its_end = bar(radius, length).tilted(0.2, 0.0)
    assert on_its_end.stance[1] == pytest.approx(length / 2 * math.sin(0.2), abs=1e-9)


@pytest.mark.parametrize("name", ["cone", "dots", "wave"])
def test_the_distance_is_that_of_the_upright_body_turned_by_hand(name: str) -> None:
    upright, points = named(name), _cloud(1000)
    leaning = upright.tilted(*TILT)
    turned = (points - [0, 0, leaning.stance[1]]) @ _turn()
    gap, normal = upright.distance(turned)
    found, found_normal = leaning.distance(points)
    np.testing.assert_allclose(found, gap, atol=1e-15)
    np.testing.assert_allclose(found_normal, normal @ _turn().T, atol=1e-9)


@pytest.mark.parametrize(
    "name",
    [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in NAMES],
)
def test_the_tip_is_at_zero_and_nothing_is_below_it(name: str) -> None:
    leaning = named(name).tilted(*TILT)
    # The surface of the upright body, sampled densely and rotated explicitly.
    sides = np.clip(named(name).bounds[:2], -9e-3, 9e-3)
    x, y = np.meshgrid(*(np.linspace(*side, 41) for side in sides), indexing="ij")
    heights = named(name).heights(x, y, reach=5e-3)
    hit = np.isfinite(heights)
    surface = np.stack([x[hit], y[hit], heights[hit]], axis=1) @ _turn().T
    lowest = surface[:, 2].min() + leaning.stance[1]
    # Between two samples the surface falls by at most the tilt times their distance.
    assert -1e-9 < lowest < np.hypot(*np.ptp(sides, axis=1)) / 40 * math.tan(math.radians(15))
    x_side, y_side, z_side = leaning.bounds_below(2e-3)
    below = surface[surface[:, 2] + leaning.stance[1] < 2e-3]
    assert x_side[0] <= below[:, 0].min() < below[:, 0].max() <= x_side[1]
    assert y_side[0] <= below[:, 1].min() < below[:, 1].max() <= y_side[1]
    assert z_side == (0.0, 2e-3)


@pytest.mark.parametrize("name", ["cylinder_si", "dotin", "prism"])
def test_mirrored_tilts_mirror_the_gap(name: str) -> None:
    upright, points = named(name), _cloud(1000)
    gap, _ = upright.tilted(*TILT).distance(points)
    about_x, about_y = TILT
    in_x, _ = upright.tilted(about_x, -about_y).distance(points * [-1, 1, 1])
    in_y, _ = upright.tilted(-about_x, about_y).distance(points * [1, -1, 1])
    np.testing.assert_allclose(in_x, gap, atol=1e-9)
    np.testing.assert_allclose(in_y, gap, atol=1e-9)


@pytest.mark.parametrize("angle", [1e-7, 0.1, 0.3])
def test_a_pin_between_the_columns_is_found(angle: float) -> None:
    # A plate at 2 mm, and a pin extending down from it.
    wall, foot = flat_punch(0.1e-3).parts
    pin = replace(wall, axis=(1.03e-3, 2.02e-3))
    plate = replace(foot, values=(0.0, -1.0, -2e-3))
    spiked = Indenter("spiked", (*box(12e-3, 12e-3).parts[:2], plate, pin, foot))
    assert float(spiked.heights(1.03e-3, 2.02e-3)) == 0
    leaning = spiked.tilted(0.0, angle)
    drop = (1.03e-3 + 0.1e-3) * math.sin(angle)
    plate_drop = 6e-3 * math.sin(angle) - 2e-3 * math.cos(angle)
    assert leaning.stance[1] == pytest.approx(max(drop, plate_drop), abs=2e-8)


def test_no_tilt_is_the_very_same_indenter() -> None:
    upright, points = named("wave"), _cloud(500)
    none = upright.tilted(0.05, 0.0).tilted(0.0, 0.0)
    assert none == upright
    for found, expected in zip(none.distance(points), upright.distance(points), strict=True):
        np.testing.assert_array_equal(found, expected)
    assert upright.tilted(0.05, 0.0).upright == upright
    assert upright.tilted(0.05, 0.0) != upright


@pytest.mark.slow
def test_a_tilt_is_from_upright_and_small_ones_change_little() -> None:
    points = _cloud(500)
    assert named("prism").tilted(0.1, 0.1).tilted(*TILT) == named("prism").tilted(*TILT)
    gap, _ = named("prism").distance(points)
    little, _ = named("prism").tilted(1e-4, 0.0).distance(points)
    assert np.abs(little - gap).max() < 3e-6


@pytest.mark.slow
def test_a_tilted_body_from_a_file_stands_like_the_exact_one(tmp_path: Path) -> None:
    path = files.write_binary(tmp_path / "block.stl", files.block(3, 4, 5))
    found = from_stl(path, edge_radius=0.4e-3, spacing=0.15e-3, reach=2.5e-3).tilted(*TILT)
    exact = box(3e-3, 4e-3, 0.4e-3).tilted(*TILT)
    assert found.stance[1] == pytest.approx(exact.stance[1], abs=5e-6)
    points = _cloud(20000) * [0.3, 0.3, 0.5]
    gap, _ = exact.distance(points)
    near = (gap > -0.05e-3) & (gap < 0.3e-3)
    np.testing.assert_allclose(found.distance(points)[0][near], gap[near], atol=8e-6)


def test_a_tilt_is_kept_in_stored_scenes_and_one_stored_before_has_none() -> None:
    scene = Scene(named("moon").tilted(0.1, -1 / 3), press([0.5e-3]))
    stored = json.loads(json.dumps(to_json(scene)))
    assert from_json(Scene, stored, "scene") == scene
    del stored["indenter"]["tilt"], stored["indenter"]["solid"]
    assert from_json(Scene, stored, "scene").indenter == named("moon")
