"""Colours of a lit skin: level, tilted, and with markers on it."""

from __future__ import annotations

import math

import numpy as np

from tests.support.colour import Lamp, Shading

RED = Lamp(azimuth=math.pi, elevation=0.5, colour=(200.0, 0.0, 0.0))
BLUE = Lamp(azimuth=0.0, elevation=0.5, colour=(0.0, 0.0, 200.0))
SHADING = Shading(lamps=(RED, BLUE), background=(50.0, 60.0, 70.0))
UP = np.array([0.0, 0.0, 1.0])


def test_a_level_skin_has_phongs_colour() -> None:
    sine = math.sin(0.5)
    lit = 0.6 * sine + 0.3 * sine**5
    expected = [0.8 * 50 + 200 * lit, 0.8 * 60, 0.8 * 70 + 200 * lit]
    np.testing.assert_allclose(SHADING.colours(UP), expected, rtol=1e-12)


def test_a_slope_that_faces_a_lamp_from_below_takes_its_colour() -> None:
    # For the camera below, a skin rising to the right faces right, towards blue.
    rising = np.array([-0.3, 0.0, math.sqrt(1 - 0.09)])
    level, leaning = SHADING.colours(UP), SHADING.colours(rising)
    assert leaning[2] > level[2] + 10
    assert leaning[0] < level[0] - 10


def test_mirrored_slopes_swap_mirrored_lamps() -> None:
    slope = np.array([0.25, 0.1, 1.0])
    slope /= np.linalg.norm(slope)
    here, there = SHADING.colours(slope), SHADING.colours(slope * [-1, 1, 1])
    # After subtracting the background, red and blue are exchanged.
    ground = 0.8 * np.array(SHADING.background)
    np.testing.assert_allclose((here - ground)[::-1], there - ground, atol=1e-9)


def test_a_skin_turned_away_from_all_lamps_shows_the_background_alone() -> None:
    away = np.array([0.0, 0.0, -1.0])
    np.testing.assert_allclose(SHADING.colours(away), 0.8 * np.array(SHADING.background))


def test_markers_are_ink_over_the_lit_skin_and_nothing_is_black() -> None:
    x = np.linspace(-1.0, 1.0, 5)
    normals = np.broadcast_to(UP, (5, 5, 3))
    material = np.zeros((2, 2, 2), np.float32)
    material[1, 1] = np.nan
    coverage = np.array([[0.0, 1.0], [0.5, 1.0]])
    picture = SHADING.image(normals, x, x, material, coverage)
    level, ink = SHADING.colours(UP), np.array(SHADING.ink)
    assert picture.dtype == np.uint8
    np.testing.assert_array_equal(picture[0, 0], np.rint(level))
    np.testing.assert_array_equal(picture[0, 1], np.rint(ink))
    np.testing.assert_array_equal(picture[1, 0], np.rint((level + ink) / 2))
    np.testing.assert_array_equal(picture[1, 1], 0)
