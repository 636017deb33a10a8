"""What the markers of a press say of the skin between them: displacement, and growth.

A `FieldReader` belongs to one untouched mask. Its frames become displacement fields on the lattice
of marker archives, [px] of the sensor that they are to be used for, or the small maps of
displacement and growth that a force model can read in place of images.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from learning.translation.flow.matching import Masks, Match, Matcher
from learning.translation.flow.spline import Floats
from learning.translation.translator import SensorView
from recorder.markers import HEIGHT, PACKED, WIDTH, Lattice, unpack

LATTICE = Lattice()
"""Where displacement fields are kept: as archives keep them."""
MAP_SIDE = 32
"""Rows and columns of the maps that a force model reads."""
SMOOTHING = 0.02
"""Of the spline: centres of patches are a tenth of a pixel off, and so may a field be."""

_MIDDLE = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])


class FieldReader:
    """Reads the frames of one sensor and reference; keeps what is computed once."""

    def __init__(self, reference: Masks, *, smoothing: float = SMOOTHING) -> None:
        """Find the markers of the reference.

        Args:
            reference: The untouched mask (480, 640).
            smoothing: How much the field may miss the markers to bend less (`Spline`).

        Raises:
            LearningError: Not bool (480, 640), or without markers.
        """
        self._matcher = Matcher(_required(reference, "reference", 2), smoothing=smoothing)
        self._smoothing = smoothing
        self._operators: dict[tuple[float, float], Floats] = {}

    @property
    def markers(self) -> Floats:
        """Column and row of the untouched markers (m, 2) [px]."""
        return self._matcher.markers

    def matches(self, frames: NDArray[Any], *, ordered: bool) -> list[Match]:
        """Return where the markers of the reference are in each frame.

        Args:
            frames: Masks, bool (n, 480, 640) or packed uint8 (n, 38400).
            ordered: The frames are one press in order of time: markers are followed.

        Raises:
            LearningError: Frames of another shape or type.
        """
        self._matcher.restart()
        matches = []
        for mask in _each(frames):
            matches.append(self._matcher.step(mask))
            if not ordered:
                self._matcher.restart()
        return matches

    def displacement(
        self,
        frames: NDArray[Any],
        *,
        ordered: bool,
        source: SensorView | None = None,
        target: SensorView | None = None,
    ) -> NDArray[np.float32]:
        """Return the displacement on `LATTICE` (n, 57, 73, 2) [px], components column and row.

        With two views, it is that of the target's image: the same motion in mm at the same place of
        the contact frame, which both have in the middle of their images. Beyond what the source
        sees, what its border does.

        Args:
            frames: Masks, bool (n, 480, 640) or packed uint8 (n, 38400).
            ordered: The frames are one press in order of time: markers are followed.
            source: What the frames show; None: the same as the target's.
            target: What the target's would.

        Raises:
            LearningError: Frames of another shape or type.
        """
        scale = _scale(source, target)
        operator = self._operator(scale)
        moved = np.stack([match.moved for match in self.matches(frames, ordered=ordered)])
        field = np.tensordot(operator, moved, axes=(1, 1)).transpose(1, 0, 2) / scale
        return field.reshape(len(moved), *LATTICE.shape).astype(np.float32)

    def maps(self, frames: NDArray[Any], *, ordered: bool) -> NDArray[np.float32]:
        """Return displacement and growth (n, 3, 32, 32): columns [px], rows [px], log of area.

        Each at the middle of a 32nd of the untouched image's width and height.

        Args:
            frames: Masks, bool (n, 480, 640) or packed uint8 (n, 38400).
            ordered: The frames are one press in order of time: markers are followed.

        Raises:
            LearningError: Frames of another shape or type.
        """
        matches = self.matches(frames, ordered=ordered)
        values = np.stack(
            [np.concatenate([one.moved, one.growth[:, None]], axis=1) for one in matches]
        )
        maps = np.tensordot(self._map_operator, values, axes=(1, 1))
        return np.moveaxis(maps, 0, -1).reshape(-1, 3, MAP_SIDE, MAP_SIDE).astype(np.float32)

    def _operator(self, scale: Floats) -> Floats:
        """Return the matrix from markers to the target's lattice (57 x 73, m)."""
        key = (float(scale[0]), float(scale[1]))
        if key not in self._operators:
            columns, rows = np.meshgrid(LATTICE.columns, LATTICE.rows)
            places = _MIDDLE + (np.stack([columns, rows], axis=-1).reshape(-1, 2) - _MIDDLE) * scale
            margin = LATTICE.margin_px
            seen = np.clip(places, -margin, np.array([WIDTH, HEIGHT]) + margin)
            self._operators[key] = self._matcher.spline.at(seen)
        return self._operators[key]

    @functools.cached_property
    def _map_operator(self) -> Floats:
        across = (np.arange(MAP_SIDE) + 0.5) / MAP_SIDE
        columns, rows = np.meshgrid(across * WIDTH - 0.5, across * HEIGHT - 0.5)
        return self._matcher.spline.at(np.stack([columns, rows], axis=-1).reshape(-1, 2))


def marker_fields(
    frames: NDArray[Any], reference: NDArray[Any], *, ordered: bool = True
) -> NDArray[np.float32]:
    """Return displacement and growth of a press (n, 3, 32, 32): columns [px], rows [px], log area.

    Args:
        frames: Masks, bool (n, 480, 640) or packed uint8 (n, 38400).
        reference: The untouched mask, bool (480, 640) or packed (38400,).
        ordered: The frames are one press in order of time: markers are followed.

    Raises:
        LearningError: Another shape or type, or a reference without markers.
    """
    mask = unpack(reference) if reference.dtype == np.uint8 else reference
    return FieldReader(mask).maps(frames, ordered=ordered)


def _scale(source: SensorView | None, target: SensorView | None) -> Floats:
    """Return how many pixels of the source one of the target is, along columns and rows (2,)."""
    if source is None or target is None:
        return np.ones(2)
    return np.array(
        [target.mm_per_column / source.mm_per_column, target.mm_per_row / source.mm_per_row]
    )


def _each(frames: NDArray[Any]) -> NDArray[np.bool_]:
    if frames.dtype == np.uint8 and frames.shape[1:] == (PACKED,):
        return unpack(frames)
    return _required(frames, "frames", 3)


def _required(masks: NDArray[Any], what: str, dimensions: int) -> Masks:
    if (
        masks.dtype != np.bool_
        or masks.ndim != dimensions
        or masks.shape[-2:] != (HEIGHT, WIDTH)
        or not len(masks)
    ):
        due = ("n, " if dimensions == 3 else "") + f"{HEIGHT}, {WIDTH}"
        raise LearningError(f"{what}: found {masks.dtype} {masks.shape}; allowed: bool ({due})")
    return masks
