"""Markers keep their identity through a sequence, despite missed and false detections."""

from typing import Any

import numpy as np
import pytest
from support import marker_truth
from support.dot_camera import MarkerCamera, PressedSurface

from learning.errors import LearningError
from learning.markers import Segmenter, preset
from learning.markers.track import Tracker
from recorder.markers import marker_centres
from tests.support.few import few


def grid(columns: int = 9, rows: int = 7, pitch: float = 60.0) -> np.ndarray[Any, Any]:
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return np.stack([x.ravel(), y.ravel()], axis=1) * pitch + 60.0


def bulge(places: np.ndarray[Any, Any], fraction: float) -> np.ndarray[Any, Any]:
    """Return the marker displacement: outwards and to the right, largest around the middle."""
    away = places - [300.0, 240.0]
    bell = np.exp(-np.sum(away**2, axis=1) / 2 / 120.0**2)[:, None]
    return fraction * (bell * [55.0, 20.0] + 0.25 * bell * away)


def shuffled(places: np.ndarray[Any, Any], random: np.random.Generator) -> Any:
    """Return positions in a different order, and the new index of each."""
    order = random.permutation(len(places))
    return places[order], np.argsort(order)


def test_names_are_kept_beyond_half_a_pitch_of_motion() -> None:
    reference, random = grid(), np.random.default_rng(1)
    tracker = Tracker(reference)
    for fraction in [*np.linspace(0, 1, 9), *np.linspace(1, 0, 9)]:
        truth = reference + bulge(reference, fraction)
        given, order = shuffled(truth + random.normal(0, 0.1, truth.shape), random)
        track = tracker.step(given)
        np.testing.assert_array_equal(track.assigned, order)
        np.testing.assert_allclose(track.place, truth, atol=0.6)
    assert np.linalg.norm(bulge(reference, 1), axis=1).max() > 0.8 * 60


def test_a_leap_of_three_quarters_of_a_pitch_is_followed_by_their_neighbours() -> None:
    reference = grid()
    moved = bulge(reference, 0.7)
    assert np.linalg.norm(moved, axis=1).max() > 0.7 * 60
    track = Tracker(reference).step(reference + moved)
    np.testing.assert_array_equal(track.assigned, np.arange(len(reference)))


@pytest.mark.parametrize("missed", [pytest.param(0.0, marks=pytest.mark.slow), 0.05])
@pytest.mark.parametrize("kind", few(["sheared", "all alike", "pressed"], 1))
def test_no_identity_is_wrong_after_leaps_of_half_a_pitch_there_and_back(
    kind: str, missed: float
) -> None:
    lost = seen = 0
    for seed in range(3):
        random = np.random.default_rng(seed)
        reference = grid(13, 11, 50.0)
        reference += random.normal(0, 1.5, reference.shape)
        angle = random.uniform(0, 2 * np.pi)
        away = reference - reference.mean(axis=0) - random.uniform(-60, 60, 2)
        bell = np.exp(-np.sum(away**2, axis=1) / 2 / 110.0**2)[:, None]
        leap = {
            "all alike": np.tile([np.cos(angle), np.sin(angle)], (len(reference), 1)),
            "sheared": bell * [np.cos(angle), np.sin(angle)],
            "pressed": bell * away,
        }[kind]
        most = 0.45 if kind == "all alike" else 0.5
        leap *= most * 50.0 / np.linalg.norm(leap, axis=1).max()
        tracker = Tracker(reference)
        for times in (0, 1, 2, 3, 2, 1, 0, 1, 0):
            names = np.flatnonzero(random.uniform(size=len(reference)) >= missed)
            truth = (reference + times * leap)[names]
            given, order = shuffled(truth + random.normal(0, 0.3, truth.shape), random)
            track = tracker.step(given)
            right = np.full(len(reference), -1)
            right[names] = order
            assert not ((track.assigned >= 0) & (track.assigned != right)).any()
            lost += int(((track.assigned < 0) & (right >= 0)).sum())
            seen += len(names)
    assert lost <= 0.02 * seen


def test_markers_that_are_lost_are_found_again_under_their_names() -> None:
    reference, random = grid(), np.random.default_rng(2)
    tracker = Tracker(reference)
    fractions = [*np.linspace(0, 1, 12), *np.linspace(1, 0, 12)]
    hidden = random.choice(len(reference), 9, replace=False)
    for number, fraction in enumerate(fractions):
        truth = reference + bulge(reference, fraction)
        seen = np.ones(len(truth), bool)
        if 4 <= number < 16:
            seen[hidden] = False
        names = np.flatnonzero(seen)
        false = np.array([[20.0, 20.0], [590.0, 30.0]])
        track = tracker.step(np.concatenate([truth[names], false]))
        expected = np.full(len(truth), -1)
        expected[names] = np.arange(len(names))
        np.testing.assert_array_equal(track.assigned, expected)
        assert np.isnan(track.place[track.lost]).all()
        # The expected position of a lost marker stays near the true one.
        assert np.linalg.norm(track.expected - truth, axis=1).max() < 25


def test_a_frame_without_markers_loses_all_and_the_next_finds_them() -> None:
    tracker = Tracker(grid())
    assert tracker.step(np.zeros((0, 2))).lost.all()
    assert not tracker.step(grid() + 3.0).lost.any()
    tracker.restart()
    assert not tracker.step(grid()).lost.any()


def test_one_marker_is_a_reference_too() -> None:
    tracker = Tracker(np.array([[320.0, 240.0]]))
    np.testing.assert_array_equal(tracker.step(np.array([[330.0, 240.0]])).place, [[330.0, 240.0]])
    assert tracker.step(np.array([[500.0, 100.0]])).lost.all()


def test_pictures_of_the_mock_bench_are_tracked_to_a_quarter_of_a_pixel() -> None:
    camera = MarkerCamera(marker_truth.VIEWS["bench-tacpalm"], grey_noise=1.0)
    segmenter = Segmenter(preset("bench-tacpalm"))  # type: ignore[arg-type]
    tracker, order = None, np.zeros(0, int)
    for fraction in np.linspace(0, 1, 6):
        surface = PressedSurface(
            (1e-3, 0.0), 4e-3 * fraction, 3e-3, 12e-3, (1.5e-3 * fraction, 0.0)
        )
        picture, truth = camera.image(surface), camera.pixels(surface)
        centres = marker_centres(segmenter.mask(picture))
        if tracker is None:
            tracker = Tracker(centres)
            apart = np.linalg.norm(truth[:, None] - centres[None], axis=-1)
            order = apart.argmin(axis=0)
        track = tracker.step(centres)
        assert not track.lost.any()
        np.testing.assert_allclose(track.place, truth[order], atol=0.25)


def test_references_and_centres_that_are_no_places_are_refused() -> None:
    for reference, message in (
        (np.zeros((0, 2)), "allowed"),
        (np.zeros((4, 3)), "found shape"),
        (np.full((4, 2), np.nan), "found NaN"),
    ):
        with pytest.raises(LearningError, match=message):
            Tracker(reference)
    with pytest.raises(LearningError, match="finite"):
        Tracker(grid()).step(np.array([[np.nan, 1.0]]))
