"""Device variation: draws by seed and name with the stated spread; off means unchanged."""

import math
from dataclasses import astuple
from typing import Any

import numpy as np
import pytest

from sim.result import to_json
from sim.scene import press
from sim.sensors import (
    DeviceVariation,
    Drift,
    Framing,
    Grip,
    Mount,
    Placement,
    Segmentation,
    SegmentationErrors,
)
from sim.sensors.pins import tip_coverage
from sim.sensors.variation import generator, softened

MANY = [f"sensor {index}" for index in range(400)]


def test_draws_depend_on_seed_and_names_alone() -> None:
    draws = [generator(1, "a", 2).random() for _ in range(3)]
    assert len(set(draws)) == 1
    others = [(2, "a", 2), (1, "b", 2), (1, "a", 3), (1, "a"), (1, 2, "a")]
    assert draws[0] not in [generator(*other).random() for other in others]


@pytest.mark.parametrize(
    ("drawn", "most"),
    [
        (
            lambda name: astuple(Mount(0.3e-3, math.radians(2), height=30e-6).drawn(0, name)),
            [0.3e-3, 0.3e-3, math.radians(2), 30e-6],
        ),
        (lambda name: Grip(math.radians(1.5)).drawn(3, "array-i", name), [math.radians(1.5)] * 2),
        (lambda name: Framing(4.0, 0.01).drawn(0, name), [4.0, 4.0, 0.01]),
    ],
    ids=["mounts", "grips, of each indenter", "framings"],
)
def test_lives_are_drawn_evenly_within_their_limits(drawn: Any, most: list[float]) -> None:
    values = np.array([drawn(name) for name in MANY])
    assert tuple(drawn(MANY[0])) == tuple(values[0])
    assert (np.abs(values).max(axis=0) <= most).all()
    np.testing.assert_allclose(values.std(axis=0) * math.sqrt(3), most, rtol=0.1)
    assert (np.abs(values.mean(axis=0)) < 0.1 * np.array(most)).all()
    assert len(np.unique(values[:, 0])) == len(MANY)


def test_a_placement_moves_the_press_on_the_gel_against_the_sensors_shift() -> None:
    motion = Placement(shift_x=1e-3, shift_y=-2e-3).motion(press([1e-3], at=(3e-3, 4e-3)))
    assert motion.tip[-1] == pytest.approx((2e-3, 6e-3, -1e-3))
    assert Placement(height=20e-6).motion(motion).tip[-1][2] == pytest.approx(-1.02e-3)


def test_a_mount_without_an_error_of_height_is_stored_and_drawn_as_ever() -> None:
    mount = Mount(shift=0.3e-3, turn=0.0)
    assert to_json(mount) == {"shift": 0.3e-3, "turn": 0.0}
    x, y, _ = generator(3, "mount", "a").uniform(-1.0, 1.0, 3).tolist()
    assert mount.drawn(3, "a") == Placement(0.3e-3 * x, 0.3e-3 * y)


def test_a_skin_creeps_as_a_random_walk_that_begins_at_home() -> None:
    walks = np.array([Drift(5e-6).drawn(90, 0, "array-i", name) for name in MANY])
    assert not walks[:, 0].any()
    np.testing.assert_allclose(walks[:, 40].std(axis=0), 5e-6 * math.sqrt(40), rtol=0.1)
    np.testing.assert_allclose(walks[:, 89].std(axis=0), 5e-6 * math.sqrt(89), rtol=0.1)
    np.testing.assert_array_equal(Drift(5e-6).drawn(5, 0, "a"), Drift(5e-6).drawn(9, 0, "a")[:5])


def test_nothing_is_on_unless_asked_for() -> None:
    variation = DeviceVariation()
    assert [
        variation.mount,
        variation.grip,
        variation.framing,
        variation.drift,
        variation.segmentation,
    ] == [None] * 5
    assert Mount(0.0, 0.0).drawn(0, "a") == Placement()
    assert Grip(0.0).drawn(0, "a", "b") == (0.0, 0.0)


def discs(count: int = 20) -> np.ndarray:
    """Return grey images of a grid of 6 x 8 discs of radius 9 px, at random subpixel positions."""
    column, row = np.meshgrid(np.arange(8) * 72.0 + 60, np.arange(6) * 72.0 + 60)
    places = np.stack([column.ravel(), row.ravel()], axis=1)
    offsets = np.random.default_rng(1).uniform(0, 1, (count, 1, 2))
    return tip_coverage(places + offsets, np.full((count, 48), 9.0), width=640, height=480)


def test_softening_is_the_gaussian_of_a_pixel_as_closely_as_five_weights_can_be() -> None:
    image = np.zeros((9, 11), np.uint8)
    image[4, 5] = 255
    soft = softened(image).astype(float) / (256 * 255)
    across, down = soft.sum(axis=0), soft.sum(axis=1)
    np.testing.assert_allclose(across[3:8], np.array([1, 4, 6, 4, 1]) / 16)
    np.testing.assert_allclose(down[2:7], across[3:8])
    assert across @ (np.arange(11) - 5) ** 2 == pytest.approx(1.0)
    assert (softened(np.full((4, 4), 255, np.uint8)) == 256 * 255).all()


def test_segmentation_of_nothing_gives_the_plain_masks() -> None:
    grey = discs()
    np.testing.assert_array_equal(
        SegmentationErrors(Segmentation(), 0, "a").masks(grey), grey >= 128
    )


def test_a_vanishing_jitter_changes_next_to_nothing() -> None:
    grey = discs()
    seen = SegmentationErrors(Segmentation(jitter_px=1e-6), 0, "a").masks(grey)
    assert (seen != (grey >= 128)).mean() < 0.02 * (grey >= 128).mean()


def test_edges_waver_by_the_stated_deviation() -> None:
    """A straight edge at subpixel positions that vary from row to row, measured by counting."""
    jitter = 0.4
    edge = 320 + 20 * np.arange(480) / 480
    fraction = np.clip(edge[:, None] + 0.5 - np.arange(640), 0, 1)
    grey = np.rint(255 * np.broadcast_to(fraction, (60, 480, 640))).astype(np.uint8)
    seen = SegmentationErrors(Segmentation(jitter_px=jitter, correlation_px=4.0), 0, "a").masks(
        grey
    )
    moved = seen.sum(axis=2) - (edge + 0.5)
    # Counting whole pixels adds the variance of a uniform distribution over one of them.
    assert moved.var() == pytest.approx(jitter**2 + 1 / 12, rel=0.08)
    assert abs(moved.mean()) < 0.03


def test_jitter_hangs_together_along_an_edge() -> None:
    def flips(correlation: float) -> int:
        grey = np.zeros((4, 480, 640), np.uint8)
        grey[:, :, :320] = 255
        errors = Segmentation(jitter_px=1.0, correlation_px=correlation)
        width = SegmentationErrors(errors, 0, "a").masks(grey).sum(axis=2)
        return int((np.diff(width, axis=1) != 0).sum())

    assert flips(20.0) < 0.5 * flips(4.0)


def test_the_stated_share_of_markers_is_missed_whole() -> None:
    grey = discs(100)
    plain = grey >= 128
    seen = SegmentationErrors(Segmentation(missing=0.05), 0, "a").masks(grey)
    assert not (seen & ~plain).any()
    fraction = 1 - seen.sum() / plain.sum()
    assert fraction == pytest.approx(0.05, abs=4 * math.sqrt(0.05 * 0.95 / 4800))
    kept = seen[:, 60:72, 60:72].any(axis=(1, 2))
    assert (seen[:, 50:72, 50:72].sum(axis=(1, 2))[kept] > 230).all()


def test_only_markers_that_reach_into_the_rim_are_lost_there() -> None:
    grey = discs(20)
    plain = grey >= 128
    seen = SegmentationErrors(Segmentation(rim_px=60.0, rim_missing=1.0), 0, "a").masks(grey)
    inside = np.zeros((480, 640), bool)
    inside[100:-100, 100:-100] = True
    np.testing.assert_array_equal(seen[:, inside], plain[:, inside])
    assert not seen[:, :60].any()
    assert not seen[:, :, :60].any()


def test_a_frame_has_the_same_errors_in_any_batch_and_others_in_another_session() -> None:
    grey = discs(6)
    errors = Segmentation(jitter_px=0.5, missing=0.02)
    whole = SegmentationErrors(errors, 0, "a").masks(grey)
    np.testing.assert_array_equal(
        SegmentationErrors(errors, 0, "a").masks(grey[4:], first=4), whole[4:]
    )
    assert (SegmentationErrors(errors, 0, "b").masks(grey) != whole).any()
