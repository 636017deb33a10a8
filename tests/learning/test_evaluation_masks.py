"""Overlap and marker metrics of masks against hand-computed values, and the nearest frame."""

import numpy as np
import pytest
from numpy.typing import NDArray

from learning.errors import LearningError
from learning.evaluation.translation import (
    endpoint_errors,
    marker_errors,
    nearest_frames,
    overlap,
    structural_similarity,
)
from recorder.markers import HEIGHT, WIDTH, Lattice


def squares(*corners: tuple[int, int], side: int = 20) -> NDArray[np.bool_]:
    """Return one mask with squares; upper left corners given as column and row."""
    mask = np.zeros((1, HEIGHT, WIDTH), np.bool_)
    for column, row in corners:
        mask[0, row : row + side, column : column + side] = True
    return mask


def test_dice_and_iou_of_a_shifted_square_are_those_of_its_overlap() -> None:
    found = overlap(squares((100, 100)), squares((105, 100)))
    assert found.dice == pytest.approx([15 / 20])
    assert found.iou == pytest.approx([15 / 25])
    assert found.area_ratio_error == pytest.approx([0])


def test_masks_that_never_meet_have_no_dice_and_empty_ones_all_of_it() -> None:
    nothing = np.zeros_like(squares())
    assert overlap(squares((0, 0)), squares((50, 50))).dice == pytest.approx([0])
    assert overlap(nothing, nothing).dice == pytest.approx([1])
    assert overlap(nothing, nothing).iou == pytest.approx([1])
    assert np.isnan(overlap(nothing, nothing).area_ratio_error)


def test_the_error_of_the_area_counts_too_much_as_too_little() -> None:
    both, one = squares((0, 0), (50, 50)), squares((0, 0))
    assert overlap(both, one).area_ratio_error == pytest.approx([1])
    assert overlap(one, both).area_ratio_error == pytest.approx([0.5])


def test_structural_similarity_is_that_of_each_pair_and_its_definition() -> None:
    level = np.full((1, 40, 40), 100, np.uint8)
    drawn = np.random.default_rng(3).integers(0, 255, (1, 40, 40), np.uint8)
    true = np.concatenate([level, drawn, drawn])
    found = np.concatenate([2 * level, drawn, np.roll(drawn, 3, axis=2)])
    same_level, same, shifted = structural_similarity(found, true)
    # Of uniform images only the comparison of means differs from 1.
    means = (2 * 100 * 200 + 2.55**2) / (100**2 + 200**2 + 2.55**2)
    assert (same_level, same) == pytest.approx((means, 1))
    assert abs(shifted) < 0.1


def test_markers_are_as_far_off_as_they_were_moved() -> None:
    true = squares((100, 100), (200, 100), (300, 300))
    apart, mismatched = marker_errors(squares((103, 104), (200, 100), (300, 301)), true)
    assert np.sort(np.linalg.norm(apart, axis=1)) == pytest.approx([0, 1, 5])
    assert [3.0, 4.0] in apart.tolist()
    assert not mismatched.any()


def test_a_marker_too_few_is_a_mismatch_and_does_not_move_the_others() -> None:
    true = np.concatenate([squares((100, 100), (200, 100)), squares((100, 100))])
    found = np.concatenate([squares((100, 100)), squares((100, 100))])
    apart, mismatched = marker_errors(found, true)
    assert mismatched.tolist() == [True, False]
    assert apart == pytest.approx(np.zeros((2, 2)))
    # Frames without markers have no distances.
    apart, mismatched = marker_errors(np.zeros_like(squares()), squares((100, 100)))
    assert apart.shape == (0, 2)
    assert mismatched.tolist() == [True]


def test_markers_where_the_field_takes_them_have_no_endpoint_error() -> None:
    lattice = Lattice()
    reference = squares((100, 100), (300, 200))
    field = np.broadcast_to(np.array([6.0, -8.0]), lattice.shape)[None]
    moved, stayed = squares((106, 92), (306, 192)), reference
    assert endpoint_errors(moved, reference[0], field, lattice) == pytest.approx(np.zeros((2, 2)))
    missed = endpoint_errors(stayed, reference[0], field, lattice)
    assert missed == pytest.approx(np.array([[-6.0, 8.0]] * 2))
    # Markers without material are left out.
    partly = field.copy()
    partly[0, :, : lattice.shape[1] // 3] = np.nan
    assert len(endpoint_errors(moved, reference[0], partly, lattice)) == 1


def test_the_nearest_frame_is_of_the_same_phase_and_motion() -> None:
    table = {
        "position": np.array([[0, 0], [4e-3, 0], [0, 0], [0, 0], [1e-3, 0]]),
        "depth": np.array([1.0, 1.0, 0.5, 1.0, 1.0]) * 1e-3,
        "phase": np.array([0, 0, 0, 1, 0]),
    }
    wanted = np.array([4, 3])
    assert nearest_frames(table, wanted, np.array([0, 1, 2])).tolist() == [0, 0]
    assert nearest_frames(table, wanted, np.array([1, 2, 3])).tolist() == [2, 3]
    with pytest.raises(LearningError, match="no frames to choose from"):
        nearest_frames(table, wanted, np.empty(0, np.int64))
