"""Frames whose markers are not those of their reference, told of where the frame comes from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from recorder.archive import MarkerCount
from recorder.markers import MarkerCheck, find_blobs, unpack

FLAG, INVALID = "marker_flag", "invalid"
"""Keys of a line of provenance: what the marker count said, and why there is no frame."""


class Flagger:
    """Counts the markers of one sensor's frames."""

    def __init__(self, name: str, references: NDArray[np.uint8], count: MarkerCount | None) -> None:
        """Prepare to compare with references.

        Args:
            name: Of the sensor.
            references: Packed masks of the untouched sensor (K, 38400).
            count: How markers are counted; None: they are not.

        Raises:
            LearningError: A reference without markers.
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
        """Return what is wrong with the markers of frames, by row; nothing of sound ones.

        Args:
            masks: Frames (n, 480, 640).
            reference: Number of the reference of each (n,).
            there: Which of them there are (n,).
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
