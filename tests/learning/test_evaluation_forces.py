"""Force errors against hand-computed values, and predictions on disk."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.predicted_forces import TRUE, predictions

from learning.errors import LearningError
from learning.evaluation.predictions import (
    ALL,
    csv_text,
    force_rows,
    gain_line,
    merged,
    read_predictions,
    unscored_lines,
)
from learning.metrics import force_errors, r_squared, spread_and_range, with_magnitude


def test_the_mean_absolute_error_is_that_of_each_axis_and_of_the_magnitude() -> None:
    predicted = TRUE + np.array([0.1, -0.2, 0.0])
    predicted[1] = [0.0, 0.0, -4.0]  # of magnitude 5, predicted as 4
    errors = force_errors(TRUE[:2], predicted[:2], np.array([1.0, 2.0, 4.0, 0.5]))
    magnitude = np.sqrt(0.01 + 0.04 + 1) - 1
    expected = np.array([1.55, 0.1, 0.0, (magnitude + 1) / 2])
    assert errors.mae == pytest.approx(tuple(expected))
    assert errors.relative == pytest.approx(tuple(expected / [1, 2, 4, 0.5]))
    assert errors.shear == pytest.approx((1.55 + 0.1) / 2)
    assert with_magnitude(TRUE)[:, 3] == pytest.approx([1, 5, 1, np.sqrt(3)])


def test_r2_is_one_for_the_truth_zero_for_the_mean_and_below_for_worse() -> None:
    true = np.array([[1.0], [2.0], [6.0]])
    assert r_squared(true, true) == pytest.approx([1])
    assert r_squared(true, np.full((3, 1), 3.0)) == pytest.approx([0])
    # Labels are -2, -1 and 3 off their mean (squares: 14), predictions 5, 4 and 0 off (41).
    assert r_squared(true, np.full((3, 1), 6.0)) == pytest.approx([1 - 41 / 14])
    # Of labels that never change it is no number.
    assert np.isnan(r_squared(np.ones((4, 1)), np.zeros((4, 1))))


def test_the_spread_leaves_out_frames_without_a_label() -> None:
    std, range_ = spread_and_range(np.concatenate([TRUE, np.full((1, 3), np.nan)]))
    assert std[2] == pytest.approx(TRUE[:, 2].std())
    assert range_ == pytest.approx([3, 1, 4, 4])


def test_errors_are_of_measured_axes_alone() -> None:
    true, predicted = TRUE.copy(), TRUE + 0.5
    true[:, :2] = np.nan
    true[0, 2] = np.nan
    errors = force_errors(true, predicted, spread_and_range(true)[0])
    assert (errors.axes, errors.of_axes, errors.frames) == (("Fz",), " (Fz)", 3)
    assert errors.mae[2] == pytest.approx(0.5)
    assert np.isnan([*errors.mae[:2], errors.mae[3], *errors.r2[:2], errors.shear]).all()
    fz = TRUE[1:, 2]
    assert errors.r2_mean == pytest.approx(1 - 0.75 / np.square(fz - fz.mean()).sum())
    assert errors.relative[2] == pytest.approx(0.5 / fz.std())


def test_an_axis_that_the_model_does_not_predict_is_not_scored() -> None:
    predicted = TRUE + 0.5
    predicted[:, 0] = np.nan
    assert force_errors(TRUE, predicted, np.ones(4)).axes == ("Fy", "Fz")


def test_predictions_without_labels_have_no_row_but_a_range() -> None:
    one = predictions()
    bare = replace(one, true=np.full_like(one.true, np.nan))
    partly = replace(one, true=np.where([False, False, True], one.true, np.nan))
    assert force_rows([bare]) == ()
    assert [row.errors.axes for row in force_rows([partly])] == [("Fz",)] * 3
    assert "R2 (Fz)" not in gain_line(force_rows([one]))
    assert gain_line(force_rows([partly])).endswith("(Fz)")
    lines = unscored_lines([bare])
    assert [(line["axis"], line["frames"]) for line in lines] == [("Fx", 8), ("Fy", 8), ("Fz", 8)]
    assert (lines[2]["low_n"], lines[2]["high_n"]) == (-3.5, 0.5)
    assert [line["axis"] for line in unscored_lines([partly])] == ["Fx", "Fy"]


def test_predictions_come_back_as_they_were_written(tmp_path: Path) -> None:
    one = predictions("transferred", translator="field")
    one.write(tmp_path / "one.npz")
    back = read_predictions(tmp_path / "one.npz")
    assert back.key == one.key
    assert back.true.tolist() == one.true.tolist()
    assert back.indenter.tolist() == one.indenter.tolist()
    assert [path.name for path in tmp_path.iterdir()] == ["one.npz"]


def test_what_is_no_prediction_is_refused(tmp_path: Path) -> None:
    wrong = predictions().predicted.copy()
    wrong[3, 0] = np.nan
    with pytest.raises(LearningError, match="in row 3 of predicted"):
        replace(predictions(), predicted=wrong)
    with pytest.raises(LearningError, match="'finetuned'; allowed: source-only"):
        predictions("finetuned")
    cut, other = tmp_path / "cut.npz", tmp_path / "other.npz"
    predictions().write(cut)
    cut.write_bytes(cut.read_bytes()[:-200])
    np.savez(other, weights=np.zeros(3))
    for path in (cut, other):
        with pytest.raises(LearningError, match=rf"{path.name}: found no results"):
            read_predictions(path)


def test_predictions_of_one_pair_in_several_files_are_one() -> None:
    seen = predictions(roles=("new_press",), first=100)
    (one,) = merged([predictions(roles=("new_indenter",)), seen])
    assert one.rows.tolist() == [*range(4), *range(100, 104)]
    assert one.role[[0, 7]].tolist() == ["new_indenter", "new_press"]


def test_frames_predicted_twice_and_one_variant_by_two_models_are_refused() -> None:
    with pytest.raises(LearningError, match="row 0 twice"):
        merged([predictions(), predictions(off=0.1)])
    with pytest.raises(LearningError, match="allowed: one"):
        merged([predictions(), replace(predictions(first=100), model="b" * 64)])


def test_the_table_has_a_row_for_each_role_and_one_for_all() -> None:
    rows = force_rows([predictions(off=0.5)])
    assert [row.role for row in rows] == ["new_indenter", "new_press", ALL]
    assert [row.errors.frames for row in rows] == [4, 4, 8]
    assert rows[2].value("mae_fz_n") == pytest.approx(0.5)
    assert rows[2].value("mae_fz_over_std") == pytest.approx(0.5 / TRUE[:, 2].std())


def test_the_line_of_gains_says_before_then_after() -> None:
    rows = force_rows([predictions("transferred", off=0.0, translator="flow"), predictions()])
    assert gain_line(rows).startswith("source-only R2 0.574  ")
    assert gain_line(rows).endswith("  transferred, flow R2 1.000")


def test_a_number_that_there_is_not_is_left_empty_in_a_csv() -> None:
    assert csv_text([{"a": 1.5, "b": float("nan"), "c": "x,y"}]) == 'a,b,c\n1.5,,"x,y"\n'
