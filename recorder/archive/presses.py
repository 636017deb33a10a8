"""Rows of a sensor's table, press by press."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray


def press_rows(
    table: Mapping[str, np.ndarray[Any, Any]], *parts: str
) -> dict[tuple[int, ...], NDArray[np.int64]]:
    """Return the rows of each press of a sensor, in order of their frames.

    Rows that are not valid, and those without a location, belong to none.

    Args:
        table: Table of the sensor: columns `location`, `frame`, `valid`, and those of `parts`.
        parts: Integer columns that divide a press, such as `phase`.

    Returns:
        Rows (k,) by location and values of `parts`, ascending. A location belongs to one press.
    """
    rows = np.flatnonzero((table["location"] >= 0) & table["valid"]).astype(np.int64)
    if not len(rows):
        return {}
    keys = [np.asarray(table[name][rows], np.int64) for name in ("location", *parts)]
    order = np.lexsort((table["frame"][rows], *reversed(keys)))
    rows, key = rows[order], np.stack(keys, axis=1)[order]
    starts = np.flatnonzero(np.r_[True, (np.diff(key, axis=0) != 0).any(axis=1)])
    parted = np.split(rows, starts[1:])
    return dict(zip(map(tuple, key[starts].tolist()), parted, strict=True))
