"""The camera: a pinhole with correct projection, mount and inverse."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import recorder.markers
from sim.markers import DISTANCE, FOCAL, HEIGHT, WIDTH, Camera
from sim.scene import Body

PLACES = np.random.default_rng(3).uniform(-8e-3, 8e-3, (200, 2))
FLAT = np.concatenate([PLACES, np.zeros((200, 1))], axis=1)
MOUNTED = Camera(shift=(12.5, -7.25), rotation=0.2)
TILTED = replace(MOUNTED, tilt=(0.1, -0.05))


def test_the_papers_camera_sees_33_9_micrometres_a_pixel() -> None:
    camera = Camera.paper()
    assert camera.focal == pytest.approx(622.2, abs=0.03)
    assert camera.mm_per_px == pytest.approx(0.0339, abs=5e-5)
    assert camera.project(np.zeros(3)) == pytest.approx((319.5, 239.5))


def test_an_image_is_as_large_as_a_mask() -> None:
    assert (WIDTH, HEIGHT) == (recorder.markers.WIDTH, recorder.markers.HEIGHT)


def test_a_camera_of_a_scale_has_that_scale() -> None:
    camera = Camera.of_scale(0.0249)
    assert camera.mm_per_px == pytest.approx(0.0249)
    step = np.diff(camera.project(np.array([[0.0, 0, 0], [0.0249e-3, 0, 0]])), axis=0)
    assert step[0] == pytest.approx((1, 0))


def test_a_mount_turns_the_image_anticlockwise_and_then_shifts_it() -> None:
    turned = Camera(rotation=math.pi / 2, shift=(3.0, 5.0))
    column, row = turned.project(np.array([1e-3, 0.0, 0.0]))
    assert column == pytest.approx(319.5 + 3)
    assert row == pytest.approx(239.5 - FOCAL * 1e-3 / DISTANCE + 5)
    plain, mounted = Camera.paper().project(FLAT), MOUNTED.project(FLAT)
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(plain, axis=0), axis=1),
        np.linalg.norm(np.diff(mounted, axis=0), axis=1),
    )


@pytest.mark.parametrize("camera", [Camera.paper(), MOUNTED, TILTED, Camera.of_scale(0.05)])
@pytest.mark.parametrize("body", [Body(), Body(dome_radius=60e-3)], ids=["flat", "dome"])
def test_places_are_those_whose_image_the_pixels_are(camera: Camera, body: Body) -> None:
    height = np.array([body.height(float(x), float(y)) for x, y in PLACES])
    pixels = camera.project(np.concatenate([PLACES, height[:, None]], axis=1))
    np.testing.assert_allclose(camera.places(pixels, body), PLACES, atol=1e-15)


def test_a_tilted_camera_sees_as_one_that_is_turned_about_its_pinhole() -> None:
    points = np.column_stack([PLACES, -np.abs(PLACES[:, 0])])
    tilted = Camera(tilt=(0.1, -0.05))
    # By hand: the gel turned the other way about the pinhole, seen by a level camera.
    pinhole, turn = np.array([0, 0, DISTANCE]), Rotation.from_rotvec([-0.1, 0.05, 0.0])
    turned, axis = turn.apply(points + pinhole), turn.apply(pinhole)
    level, middle = (Camera().project(each - pinhole) for each in (turned, axis))
    np.testing.assert_allclose(
        tilted.project(points), level - middle + tilted.project(np.zeros(3)), atol=1e-9
    )
    assert tilted.project(np.array([0, 0, -1e-3])) == pytest.approx((319.5, 239.5))
    np.testing.assert_allclose(tilted.depths(points), turned[:, 2], rtol=1e-12)
    # A camera turned about x looks towards -y: what lies there is farther, and smaller.
    near, far = Camera(tilt=(0.1, 0.0)).project(np.array([[0, 5e-3, 0], [0, -5e-3, 0]]))
    assert abs(near[1] - 239.5) != pytest.approx(abs(far[1] - 239.5), rel=0.02)
    assert near[1] < 239.5 < far[1]


def test_a_ray_beside_a_domes_sphere_sees_nothing() -> None:
    far = Camera(distance=0.2)
    places = far.places(np.array([[319.5, 239.5], [0.0, 0.0]]), Body(dome_radius=60e-3))
    assert places[0] == pytest.approx((0, 0))
    assert np.isnan(places[1]).all()


def test_x_is_to_the_right_y_is_up_and_what_is_nearer_looks_larger() -> None:
    """In images, and in the pixels of the measure of errors."""
    points = np.concatenate([FLAT[:, :2], -np.abs(FLAT[:, :1])], axis=1)
    by_hand = FOCAL * points[:, :2] / (DISTANCE + points[:, 2:])
    assert np.array_equal(Camera.paper().on_film(points), by_hand)
    flipped = Camera.paper().project(points) - (319.5, 239.5)
    np.testing.assert_allclose(flipped * (1, -1), by_hand, atol=1e-9)
