"""Error measures: force, surface and markers of one outcome against another."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.accuracy.cases import compare
from sim.markers.camera import DISTANCE, FOCAL
from sim.metrics import Outcome, displacement_at, marker_pixels, marker_places
from sim.result import WEAK
from sim.scene import Body

BODY = Body()


def dent(x, y, frames=2):
    """Return a smooth field: deeper frame by frame, moving outwards around the dent."""
    near = np.exp(-(x[:, None] ** 2 + y[None, :] ** 2) / (4e-3) ** 2)
    field = np.stack([0.2 * x[:, None] * near, 0.2 * y[None, :] * near, -1e-3 * near], axis=-1)
    return np.stack([field * (frame + 1) / frames for frame in range(frames)])


def outcome(x, y, force=((0, 0, -0.5), (0, 0, -2.0)), touched_within=2e-3):
    near = np.hypot(x[:, None], y[None, :]) < touched_within
    return Outcome(
        force=np.array(force, float),
        surface_x=x,
        surface_y=y,
        surface=dent(x, y, len(force)).astype(np.float32),
        touched=np.stack([near] * len(force)),
    )


def even(points):
    return np.linspace(-10e-3, 10e-3, points)


def graded(points):
    """Return points that are denser in the middle."""
    fraction = np.linspace(-1, 1, points)
    return 10e-3 * (0.3 * fraction + 0.7 * fraction**3)


def test_an_outcome_is_no_distance_from_itself():
    one = outcome(even(41), even(31))
    errors = compare(one, one, BODY)
    assert all(value == 0 for value in errors.worst().values())
    assert errors.force.shape == errors.force_share.shape == (2, 3)
    assert errors.surface.shape == errors.marker.shape == (2,)


def test_points_may_be_spaced_as_they_like():
    fine = outcome(even(201), even(201))
    for x in (even(61), graded(61)):
        assert 0 < compare(outcome(x, x), fine, BODY).surface[-1] < 0.5e-6
    assert compare(outcome(even(7), even(7)), fine, BODY).surface[-1] > 10e-6


def test_a_shift_of_the_surface_is_found_in_metres_and_in_pixels():
    x = even(41)
    one = outcome(x, x)
    flat = replace(one, surface=np.zeros_like(one.surface))
    shift = np.array([3e-6, -4e-6, 0.0])
    moved = replace(flat, surface=flat.surface + shift.astype(np.float32))
    errors = compare(moved, flat, BODY)
    assert errors.surface == pytest.approx([5e-6, 5e-6], rel=1e-5)
    assert errors.surface_rms == pytest.approx([5e-6, 5e-6], rel=1e-5)
    assert errors.marker == pytest.approx(2 * [5e-6 * FOCAL / DISTANCE], rel=1e-4)


def test_markers_are_a_regular_grid_over_the_body():
    x, y = marker_places(Body(size_y=10e-3))
    assert len(x) == len(y) == 14
    assert np.ptp(x) == pytest.approx(20e-3 * 13 / 14)
    assert np.ptp(y) == pytest.approx(10e-3 * 13 / 14)
    still = outcome(even(21), even(21))
    still = replace(still, surface=np.zeros_like(still.surface))
    pixels = marker_pixels(still, BODY)
    assert pixels.shape == (2, 14, 14, 2)
    step = np.diff(pixels[0, :, 0, 0])
    assert step == pytest.approx(np.full(13, 20e-3 / 14 * FOCAL / DISTANCE))


def test_a_weak_frame_is_measured_by_a_tenth_of_the_strongest():
    x = even(21)
    true = outcome(x, x, force=((0, 0, -0.01), (0, 0, -2.0)))
    found = replace(true, force=true.force + np.array([0.002, 0.0, 0.02]))
    errors = compare(found, true, BODY)
    assert errors.force[0] == pytest.approx([0.002, 0, 0.02])
    assert errors.force_share[0] == pytest.approx([0.002 / (WEAK * 2), 0, 0.02 / (WEAK * 2)])
    assert errors.force_share[1] == pytest.approx([0.001, 0, 0.01])
    assert errors.worst()["force_share"] == pytest.approx(0.1)
    assert errors.worst()["force_last"] == pytest.approx(0.01)


def test_markers_do_not_overshoot_in_a_wide_element_beside_narrow_ones():
    near = np.linspace(-0.5e-3, 0.5e-3, 41)
    x = np.concatenate([[-10e-3, -4e-3], near, [4e-3, 10e-3]])
    field = np.zeros((1, len(x), len(x), 3), np.float32)
    field[0, 2:-2, 2:-2, 2] = -1e-4 * np.hypot(near[:, None] + 0.6e-3, near) / 1e-3
    one = replace(outcome(x, x, force=((0, 0, -1),)), surface=field)
    for places in (even(301), near):
        most = np.abs(displacement_at(one, 0, places, places)).max()
        assert most < 1.1 * np.abs(field).max()
    assert displacement_at(one, 0, x, x) == pytest.approx(field[0], abs=1e-10)
