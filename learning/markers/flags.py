"""Flags for frames whose markers differ from those of their reference."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from recorder.archive import MarkerCount
from recorder.markers import MarkerCheck, count_markers, unpack

# Keys in the provenance of a frame: result of the marker count, and reason for a missing frame.
FLAG, INVALID = "marker_flag", "invalid"


def marker_flags(
    name: str,
    packed: NDArray[np.uint8],
    table: Mapping[str, NDArray[Any]],
    references: NDArray[np.uint8],
    count: MarkerCount | None,
) -> dict[int, str]:
    """Return a description of each frame whose markers are wrong, by row.

    Args:
        name: Name of the sensor.
        packed: Packed masks (n, 38400).
        table: Columns `reference` and `valid` of the frames.
        references: Packed masks of the sensor without contact (K, 38400).
        count: Settings of the marker count; None: markers are not counted.
    """
    flags: dict[int, str] = {}
    if count is None:
        return flags
    for number in np.unique(table["reference"][table["valid"]]).tolist():
        reference = unpack(references[number])
        if not count_markers(reference, count.smallest_px):
            raise LearningError(
                f"{name}: reference {number} has no marker of {count.smallest_px} px or more"
            )
        check = MarkerCheck(reference, smallest_px=count.smallest_px, tolerance=count.tolerance)
        rows = np.flatnonzero(table["valid"] & (table["reference"] == number))
        for flag in check.flags(unpack(packed[rows])):
            text = f"{flag.found} markers, reference {flag.expected}: {flag.reason}"
            flags[int(rows[flag.row])] = text
    return flags
