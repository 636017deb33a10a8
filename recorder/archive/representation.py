"""Content of a frame of an archive: the mask of its markers, or the shading of a bare gel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from recorder.markers import PACKED

# Side of a shading image, and its value where nothing changed.
SHADING_SIDE, SHADING_ZERO = 128, 128


@dataclass(frozen=True, slots=True)
class Representation:
    """One row a representation: all that differs on disk."""

    name: str
    """Name, stored as the sensor's attribute `representation`; sensors without one hold masks."""
    array: str
    """Array of the frames."""
    shape: tuple[int, ...]
    """Shape of one frame, uint8."""
    dims: tuple[str, ...]
    """Dimension names of one frame."""
    description: str
    """One sentence for readers who have only the array."""
    reference: str
    """The same for `references`."""


MASKS = Representation(
    "masks",
    "markers",
    (PACKED,),
    ("byte",),
    "mask of 480 x 640 pixels, row-major, first pixel in the highest bit, 1 = marker",
    "masks of the untouched sensor, packed as markers are",
)
SHADING = Representation(
    "shading",
    "shading",
    (3, SHADING_SIDE, SHADING_SIDE),
    ("colour", "y", "x"),
    "red, green, blue minus those of the untouched sensor, plus 128, cut to 0 to 255; each pixel "
    "the mean over a cell of the camera's image",
    "red, green, blue of the untouched sensor",
)
REPRESENTATIONS: Mapping[str, Representation] = {each.name: each for each in (MASKS, SHADING)}
