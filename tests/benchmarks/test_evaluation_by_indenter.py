"""Errors by indenter, from synthetic predictions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.predicted_forces import TRUE, predictions

from benchmarks.learning.tables.group_results import by_indenter
from learning.evaluation.predictions import Predictions
from learning.metrics import r_squared

ROLES = np.array(["new_indenter"] * 8 + ["new_press"] * 4)


def some(pair: tuple[str, str], off: float) -> Predictions:
    """Return three presses of four frames: two unseen indenters, one with errors; one seen."""
    made = replace(
        predictions("transferred", pair, translator="flow"),
        rows=np.arange(12),
        location=np.repeat(np.arange(3, dtype=np.int32), 4),
        indenter=np.repeat(["wave", "cone", "dot"], 4),
        frame=np.tile(np.arange(4, dtype=np.int32), 3),
        phase=np.zeros(12, np.int8),
        role=ROLES,
        true=np.concatenate([3 * TRUE, TRUE, 9 * TRUE]),
        predicted=np.concatenate([3 * TRUE + off, TRUE + 0.125, 9 * TRUE]),
        low=np.full((12, 3), np.nan),
        high=np.full((12, 3), np.nan),
    )
    assert len(made) == 12
    return made


def test_what_an_indenter_costs_is_told_by_all_others() -> None:
    found = by_indenter([some(("a", "b"), 1.0), some(("b", "a"), 2.0)])
    wave, cone = found["transferred", "flow"]
    assert (wave.indenter, wave.reach, wave.shear, wave.normal) == ("wave", 12.0, 1.5, 1.5)
    assert (cone.indenter, cone.reach, cone.shear, cone.normal) == ("cone", 4.0, 0.125, 0.125)
    assert wave.r2_of_others == pytest.approx(r_squared(TRUE, TRUE + 0.125).mean())
    expected = [r_squared(3 * TRUE, 3 * TRUE + off).mean() for off in (1.0, 2.0)]
    assert cone.r2_of_others == pytest.approx(np.mean(expected))
    assert cone.r2_of_others < wave.r2_of_others


def test_of_one_indenter_there_are_no_others_and_of_seen_ones_nothing() -> None:
    both = some(("a", "b"), 1.0)
    (wave,) = by_indenter([both.only(both.indenter == "wave")])["transferred", "flow"]
    assert np.isnan(wave.r2_of_others)
    assert by_indenter([both.only(both.role == "new_press")]) == {}
