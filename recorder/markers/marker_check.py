"""Check that a frame has all markers of its reference, by a count that allows for the border.

Pressing moves markers but neither creates nor destroys them, so a frame has as many as the image
without contact, except for those that cross the border. Counting only markers that are fully inside
does not help: one that is pushed against the border is lost to that count although it exists, and a
whole column of them may be cut at once. Therefore *all* patches are counted, including cut ones,
and the border may explain a difference:

- a marker of the reference **may have left** if it was cut by the border, or within a marker's
  travel of it, and no marker of the frame is near its place;
- a marker of the frame **may have come in** if it is equally near the border and no marker of the
  reference is near its place.

The travel, and the radius for "near", are half the distance between neighbours in the reference.
If the displacement field of a frame is known, "near" refers to the position to which the
field moves the marker. The field may also explain a difference: a marker on a **steep flank** of
the skin is seen edge-on, as a sliver too small to count, split in two, or merged with a neighbour.

A frame is flagged if more markers are missing than may have left or be hidden, or more are new than
may have come in or be split. Equal counts are never flagged, regardless of the displacements.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recorder.markers.displacement import Lattice, moved, on_flanks
from recorder.markers.masks import (
    HEIGHT,
    SMALLEST_PX,
    WIDTH,
    Blobs,
    Masks,
    find_blobs,
    require_masks,
)

Chosen = NDArray[np.bool_]
# Returns the displacement (h, w, 2) [px] of a frame; called only if the border is no explanation.
FieldOf = Callable[[int], NDArray[np.floating]]

# A patch above this multiple of the largest marker's area is taken for two merged markers.
_MERGED = 1.5
_NAMED = 3  # number of places that a reason lists


@dataclass(frozen=True, slots=True)
class MarkerFlag:
    """A frame whose markers differ from those of its reference."""

    row: int
    """Number of the frame."""
    found: int
    """Number of markers in the frame."""
    expected: int
    """Number of markers in the reference."""
    reason: str
    """Difference that the border cannot explain, as text."""

    def __str__(self) -> str:
        return f"row {self.row}: {self.found} markers, reference {self.expected}: {self.reason}"


class MarkerCheck:
    """Comparison of frames with one reference."""

    def __init__(
        self, reference: Masks, *, smallest_px: int = SMALLEST_PX, tolerance: int = 0
    ) -> None:
        """Find the markers of a reference, a mask without contact (480, 640).

        Patches of `smallest_px` pixels or more are counted; `tolerance` markers may be missing or
        extra beyond those that the border explains.
        """
        require_masks(reference)
        if tolerance < 0:
            raise ValueError(f"tolerance: found {tolerance}; allowed: 0 or more")
        self._blobs = find_blobs(reference[None], smallest_px)
        if not len(self._blobs):
            raise ValueError(f"reference: found no patch of {smallest_px} px or more")
        self.smallest_px, self.tolerance = smallest_px, tolerance
        self.travel_px = _half_pitch(self._blobs)

    @property
    def expected(self) -> int:
        """Number of markers in the reference, including cut ones."""
        return len(self._blobs)

    def flags(
        self,
        masks: Masks,
        first_row: int = 0,
        *,
        field_of: FieldOf | None = None,
        lattice: Lattice | None = None,
    ) -> list[MarkerFlag]:
        """Return a flag for each of frames (n, 480, 640) with other markers than the reference.

        `first_row` is the row number of the first frame; `field_of` returns the displacement of
        frame 0 to n - 1, if it is known, on a lattice, the default one if None.

        Raises:
            ValueError: Not bool (n, 480, 640).
        """
        require_masks(masks)
        blobs = find_blobs(masks, self.smallest_px)
        first = np.searchsorted(blobs.frame, np.arange(len(masks) + 1))
        flags = []
        for frame in np.flatnonzero(np.abs(np.diff(first) - self.expected) > self.tolerance):
            markers = blobs.only(slice(first[frame], first[frame + 1]))
            reason = self._reason(markers)
            if reason is not None and field_of is not None:
                field = field_of(int(frame))
                reason = self._reason(markers, field, Lattice() if lattice is None else lattice)
            if reason is not None:
                flags.append(
                    MarkerFlag(int(frame) + first_row, len(markers), self.expected, reason)
                )
        return flags

    def _reason(
        self,
        markers: Blobs,
        field: NDArray[np.floating] | None = None,
        lattice: Lattice | None = None,
    ) -> str | None:
        """Return the problem of a frame with a different count; None if it can be explained."""
        centres = self._blobs.centre
        flank = np.zeros(len(centres), np.bool_)
        if field is not None and lattice is not None:
            flank = on_flanks(centres, field, lattice)
            there = moved(centres, field, lattice)
            centres = np.where(np.isfinite(there), there, centres)
        stayed, matched = _matched(centres, markers.centre, self.travel_px)
        missing = self.expected - len(markers)
        if missing > 0:
            near = self._near_border(self._blobs)
            may_have_left = int(np.count_nonzero(~stayed & near))
            hidden = int(np.count_nonzero(~stayed & ~near & flank))
            if missing <= may_have_left + hidden + self.tolerance:
                return None
            reason = f"{missing} missing, {may_have_left} may have left the image"
            reason += f", {hidden} may be hidden on a flank" if field is not None else ""
            reason += _with_positions("; none near", self._blobs.only(~stayed & ~near & ~flank))
            merged = markers.only(markers.area > _MERGED * self._blobs.area.max())
            return reason + _with_positions("; grown together at", merged)
        near = self._near_border(markers)
        may_have_come = int(np.count_nonzero(~matched & near))
        torn = int(np.count_nonzero(flank))
        if -missing <= may_have_come + torn + self.tolerance:
            return None
        reason = f"{-missing} too many, {may_have_come} may have come into the image"
        reason += f", {torn} may be torn on a flank" if field is not None else ""
        return reason + _with_positions("; new at", markers.only(~matched & ~near))

    def _near_border(self, blobs: Blobs) -> Chosen:
        edge = np.array([WIDTH - 1, HEIGHT - 1])
        inset = np.minimum(blobs.centre, edge - blobs.centre).min(axis=1, initial=np.inf)
        return np.asarray(~blobs.whole | (inset <= self.travel_px))


def _half_pitch(blobs: Blobs) -> float:
    """Return half the median distance from a marker to its nearest neighbour [px]."""
    if len(blobs) < 2:
        return 0.5 * min(WIDTH, HEIGHT)
    apart = _distances(blobs.centre, blobs.centre)
    np.fill_diagonal(apart, np.inf)
    return 0.5 * float(np.median(apart.min(axis=1)))


def _matched(
    one: NDArray[np.float64], other: NDArray[np.float64], reach: float
) -> tuple[Chosen, Chosen]:
    """Return masks (n,), (m,) of points that are mutually nearest and within reach [px]."""
    ours, theirs = np.zeros(len(one), np.bool_), np.zeros(len(other), np.bool_)
    if len(one) and len(other):
        apart = _distances(one, other)
        nearest, back = apart.argmin(axis=1), apart.argmin(axis=0)
        here = np.arange(len(one))
        ours = (back[nearest] == here) & (apart[here, nearest] <= reach)
        theirs[nearest[ours]] = True
    return ours, theirs


def _distances(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.linalg.norm(one[:, None] - other[None], axis=-1), np.float64)


def _with_positions(message: str, blobs: Blobs) -> str:
    if not len(blobs):
        return ""
    named = ", ".join(f"({column:.0f}, {row:.0f})" for column, row in blobs.centre[:_NAMED])
    more = len(blobs) - _NAMED
    return f"{message} {named}" + (f" and {more} more" if more > 0 else "")
