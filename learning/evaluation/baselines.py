"""What a translator must beat: frames that can be shown without translating anything."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError

Rows = NDArray[np.int64]
Table = Mapping[str, NDArray[Any]]

_AT_ONCE = 2**22  # distances that are computed together


def nearest_frames(table: Table, wanted: Rows, known: Rows) -> Rows:
    """Return, for each wanted row, the known row whose motion is nearest to it (n,).

    Nearest in commanded depth and position, by Euclid's distance, among frames of the same phase;
    of all phases where that phase is not known. The indenter is not looked at: the one that is
    wanted may never have been seen.

    Args:
        table: Table of the target sensor: columns `depth`, `position`, `phase`.
        wanted: Rows to find a frame for (n,).
        known: Rows that may be shown, such as those of training (m,).

    Raises:
        LearningError: No known rows.
    """
    if not len(known):
        raise LearningError("nearest frame: found no frames to choose from; allowed: one or more")
    nearest = np.empty(len(wanted), np.int64)
    phase = table["phase"][wanted]
    for code in np.unique(phase).tolist():
        here = np.flatnonzero(phase == code)
        among = known[table["phase"][known] == code]
        among = among if len(among) else known
        step = max(_AT_ONCE // len(among), 1)
        for first in range(0, len(here), step):
            some = here[first : first + step]
            apart = _apart(_motion(table, wanted[some]), _motion(table, among))
            nearest[some] = among[apart.argmin(axis=1)]
    return nearest


def _motion(table: Table, rows: Rows) -> NDArray[np.float64]:
    """Return position and depth (n, 3) [m]."""
    return np.column_stack([table["position"][rows], table["depth"][rows]])


def _apart(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return squared distances (n, m); from differences, as the square of a metre is large here."""
    apart = np.zeros((len(one), len(other)))
    for axis in range(one.shape[1]):
        apart += np.square(one[:, axis, None] - other[None, :, axis])
    return apart
