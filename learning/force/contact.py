"""Whether a sensor is touched, told from its markers: has any edge of one moved?

The share of pixels in which a mask differs from the untouched one, over the length of the markers'
edges, is how far those edges moved on average [px]. What it is in the frames that the untouched
mask was taken from is the noise. Contact is above twice that and a little more; contact has ended
after a few frames in a row below, so that a press that passes through its untouched look does not
lose its history.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class ContactRule:
    """When a sensor counts as touched."""

    times_noise: float = 2.0
    """Of the largest motion among the untouched frames."""
    least_px: float = 0.02
    """And so much more, mean motion of the markers' edges [px of 640 x 480]."""
    frames: int = 5
    """Contact has ended after so many frames in a row below."""
    noise_px: float = 0.5
    """Untouched frames that differ by more are not untouched."""

    def __post_init__(self) -> None:
        """Refuse a rule by which nothing ever ends, or all is contact."""
        if not (self.times_noise >= 1 and self.least_px > 0 and self.frames >= 1):
            raise LearningError(
                f"contact: found {self}; allowed: times_noise 1 or more, least_px above 0, frames "
                "1 or more"
            )


class Contact:
    """Follows the masks of one sensor: is it touched?"""

    def __init__(self, untouched: NDArray[np.bool_], rule: ContactRule | None = None) -> None:
        """Take the untouched mask and its noise from frames without contact.

        Args:
            untouched: Masks (n, 480, 640), one or more.
            rule: When it counts as touched.

        Raises:
            LearningError: No markers, or frames that differ too much to be untouched.
        """
        self._rule = rule or ContactRule()
        self.reference: Mask = np.asarray(2 * untouched.sum(axis=0) > len(untouched), np.bool_)
        """What most of them show (480, 640)."""
        self._edge = _edge_length(self.reference)
        if not self._edge:
            raise LearningError("untouched frames: found no markers; allowed: another preset")
        noise = max(self.moved(mask) for mask in untouched)
        if noise > self._rule.noise_px:
            raise LearningError(
                f"untouched frames: their markers move by {noise:.2f} px; allowed: "
                f"{self._rule.noise_px} px; was the sensor touched while its reference was taken?"
            )
        self.threshold_px = self._rule.times_noise * noise + self._rule.least_px
        """Mean motion of edges above which it is touched [px]."""
        self._still = self._rule.frames
        self.motion_px = 0.0
        """Mean motion of the markers' edges in the last frame [px]."""

    def moved(self, mask: Mask) -> float:
        """Return how far the markers' edges lie from where they are untouched, on average [px]."""
        return float(np.count_nonzero(mask != self.reference)) / self._edge

    def step(self, mask: Mask) -> bool:
        """Return whether the sensor is touched in the next frame (480, 640)."""
        self.motion_px = self.moved(mask)
        self._still = 0 if self.motion_px > self.threshold_px else self._still + 1
        return self._still < self._rule.frames


def _edge_length(mask: Mask) -> int:
    """Return the number of sides that pixels of markers share with others."""
    across = np.count_nonzero(mask[:, 1:] != mask[:, :-1])
    down = np.count_nonzero(mask[1:] != mask[:-1])
    return int(across + down)
