"""How far markers lie from where they should be, and whether as many are there.

Markers of two images belong together when each is the other's nearest. Where markers lie further
off than half their distance from each other, a wrong one may be nearer: errors of that size are
told too small, and show as well in the overlap of the masks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from recorder.markers import SMALLEST_PX, Blobs, Lattice, find_blobs
from recorder.markers.displacement import moved

Floats = NDArray[np.float64]
Masks = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class MarkerErrors:
    """Markers of frames beside those of the frames they should be."""

    apart: Floats
    """From each true marker to the one found, columns and rows (m, 2) [px], of all frames."""
    found: NDArray[np.int64]
    """Markers of each frame (n,)."""
    true: NDArray[np.int64]
    """Markers there should be (n,)."""

    @property
    def mismatched(self) -> NDArray[np.bool_]:
        """Frames (n,) with more or fewer markers than there should be."""
        return np.asarray(self.found != self.true, np.bool_)


def marker_errors(found: Masks, true: Masks, smallest_px: int = SMALLEST_PX) -> MarkerErrors:
    """Return how far the centres of markers lie from those of the true frames.

    Args:
        found: What is judged (n, h, w).
        true: What it should be (n, h, w).
        smallest_px: Patches of fewer pixels are no markers.

    Raises:
        LearningError: Not as many frames, or of another size.
    """
    if found.shape != true.shape:
        raise LearningError(f"masks: found {found.shape} and {true.shape}; allowed: the same")
    ours, here = _centres(find_blobs(found, smallest_px), len(found))
    theirs, there = _centres(find_blobs(true, smallest_px), len(true))
    apart = [_apart(one, other) for one, other in zip(here, there, strict=True)]
    return MarkerErrors(np.concatenate([np.empty((0, 2)), *apart]), ours, theirs)


def endpoint_errors(
    found: Masks,
    reference: NDArray[np.bool_],
    displacement: NDArray[np.floating],
    lattice: Lattice,
    smallest_px: int = SMALLEST_PX,
) -> Floats:
    """Return how far markers lie from where the true displacement takes them (m, 2) [px].

    The end-point error of optical flow, at the markers: a marker of the untouched image at p should
    be at p + d(p). The centre of a marker that is also bent is not quite there: what true frames
    have for an error says how far that goes.

    Args:
        found: Frames that are judged (n, 480, 640).
        reference: The untouched image of the sensor that they are of (480, 640).
        displacement: Its true displacement in each frame (n, rows, columns, 2) [px].
        lattice: Where that is kept.
        smallest_px: Patches of fewer pixels are no markers.

    Raises:
        LearningError: Not as many fields as frames.
    """
    if len(found) != len(displacement):
        raise LearningError(
            f"displacement: found {len(displacement)} fields of {len(found)} frames; allowed: one "
            "each"
        )
    rest, blobs = find_blobs(reference[None], smallest_px), find_blobs(found, smallest_px)
    _, centres = _centres(blobs.only(blobs.whole), len(found))
    apart = [np.empty((0, 2))]
    for here, field in zip(centres, displacement, strict=True):
        there = moved(rest.centre[rest.whole], field, lattice)
        apart.append(_apart(here, there[np.isfinite(there).all(axis=1)]))
    return np.concatenate(apart)


def _centres(blobs: Blobs, frames: int) -> tuple[NDArray[np.int64], list[Floats]]:
    """Return how many markers each frame has (n,), and their centres frame by frame."""
    counts = np.bincount(blobs.frame, minlength=frames)
    return counts, np.split(blobs.centre, np.cumsum(counts)[:-1])


def _apart(found: Floats, true: Floats) -> Floats:
    """Return found - true (m, 2) [px] of the places that are each other's nearest."""
    if not len(found) or not len(true):
        return np.empty((0, 2))
    apart = np.linalg.norm(found[:, None] - true[None], axis=-1)
    nearest, back = apart.argmin(axis=1), apart.argmin(axis=0)
    both = back[nearest] == np.arange(len(found))
    return np.asarray(found[both] - true[nearest[both]], np.float64)
