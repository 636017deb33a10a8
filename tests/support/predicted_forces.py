"""Predicted forces with known errors."""

import numpy as np

from learning.evaluation.predictions import Predictions
from learning.metrics import spread_and_range

TRUE = np.array([[0.0, 0.0, -1.0], [3.0, 0.0, -4.0], [0.0, 1.0, 0.0], [1.0, 1.0, -1.0]])


def predictions(
    method: str = "source-only",
    pair: tuple[str, str] = ("one", "two"),
    *,
    off: float = 0.5,
    translator: str = "",
    roles: tuple[str, ...] = ("new_indenter", "new_press"),
    first: int = 0,
) -> Predictions:
    """Return four frames of each role, with a constant error on every axis."""
    count = 4 * len(roles)
    true = np.tile(TRUE, (len(roles), 1))
    std, range_ = spread_and_range(TRUE)
    return Predictions(
        *pair,
        method,
        translator,
        "a" * 64,
        rows=np.arange(first, first + count),
        location=np.repeat(np.arange(count // 2, dtype=np.int32), 2),
        indenter=np.repeat(np.array(["cone", "prism"]), count // 2),
        frame=np.tile(np.array([0, 1], np.int32), count // 2),
        phase=np.zeros(count, np.int8),
        role=np.repeat(np.array(roles), 4),
        true=true,
        predicted=true + off,
        label_std=std,
        label_range=range_,
        low=np.full((count, 3), np.nan),
        high=np.full((count, 3), np.nan),
    )
