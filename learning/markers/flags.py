"""Flags for frames whose markers differ from those of their reference."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from recorder.archive import MarkerCount
from recorder.markers import MarkerCheck, find_blobs, unpack

# Keys in the provenance of a frame: result of the marker count, and reason for a missing frame.
FLAG, INVALID = "marker_flag", "invalid"


class Flagger:
    """Counts the markers of one sensor's frames."""

    def __init__(self, name: str, references: NDArray[np.uint8], count: MarkerCount | None) -> None:
        """Prepare the comparison with references.

        Args:
            name: Name of the sensor.
            references: Packed masks of the sensor without contact (K, 38400).
            count: Settings of the marker count; None: markers are not counted.
        """
        self._checks: list[MarkerCheck] = []
        if count is None:
            return
        for number, mask in enumerate(unpack(references)):
            if not len(find_blobs(mask[None], count.smallest_px)):
                raise LearningError(
                    f"{name}: reference {number} has no marker of {count.smallest_px} px or more"
                )
            self._checks.append(
                MarkerCheck(mask, smallest_px=count.smallest_px, tolerance=count.tolerance)
            )

    def flags(
        self,
        masks: NDArray[np.bool_],
        reference: NDArray[np.integer],
        there: NDArray[np.bool_],
    ) -> dict[int, str]:
        """Return a description of each frame whose markers are wrong, by row.

        Args:
            masks: Frames (n, 480, 640).
            reference: Number of the reference of each (n,).
            there: True for frames that exist (n,).
        """
        flags: dict[int, str] = {}
        if not self._checks:
            return flags
        for number in np.unique(reference[there]).tolist():
            rows = np.flatnonzero(there & (reference == number))
            for flag in self._checks[number].flags(masks[rows]):
                text = f"{flag.found} markers, reference {flag.expected}: {flag.reason}"
                flags[int(rows[flag.row])] = text
        return flags
