"""The pattern of a gel's markers: how regular it is, and which of them a contact hides.

Markers are alike and evenly spaced, patches of shading are not.

Edges of shadows and of coloured light hide a marker, or join it to a patch of shading. Such a
marker is looked for where its neighbours predict it, by the likeness (normalised correlation) of
the contrast there to its contrast without contact. Found again, it has its patch of the reference.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from learning.markers.segment import Hat, Mask, Picture, Segmenter, hat_contrast
from learning.markers.track import GATE, Tracker
from recorder.markers import SMALLEST_PX

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Fewest markers, and largest relative spread of their areas and of the distances to the nearest
# one (half of the range from 16 to 84 %, over the median), that count as a pattern. Patterns of the
# paper have up to 0.2 and 0.25; shading and dust have 0.5 and more in one of both.
MARKERS_LEAST, SPREAD_MOST = 9, 0.45
# Distance up to which patches are neighbours [pitches], and fewest neighbours within a pattern: a
# corner of a square pattern has three.
NEIGHBOURS_WITHIN, NEIGHBOURS_LEAST = 1.75, 3


@dataclass(frozen=True, slots=True)
class Spread:
    """Number of the patches of a mask, and their spread."""

    count: int
    area: float
    """Spread of the areas, over the median."""
    pitch: float
    """Spread of the distances to the nearest patch, over the median."""

    @property
    def is_regular(self) -> bool:
        """True if there are enough patches, alike and evenly spaced."""
        return (
            self.count >= MARKERS_LEAST and self.area <= SPREAD_MOST and self.pitch <= SPREAD_MOST
        )

    def __str__(self) -> str:
        return (
            f"{self.count} patches whose areas spread {100 * self.area:.0f} % and whose distances "
            f"spread {100 * self.pitch:.0f} %; markers are {MARKERS_LEAST} or more, within "
            f"{100 * SPREAD_MOST:.0f} %"
        )


def spread_of(area: NDArray[np.int64], centre: Floats) -> Spread:
    """Return number and spread of the patches of one mask, by areas (m,) and centres (m, 2)."""
    if len(area) < 2:
        return Spread(len(area), 0.0, 0.0)
    return Spread(len(area), _spread(area), _spread(pitch_of(centre)))


def pitch_of(centre: Floats) -> Floats:
    """Return the distance (m,) of each of two or more centres (m, 2) to the nearest other [px]."""
    return np.asarray(cKDTree(centre).query(centre, 2)[0][:, 1])


def in_pattern(centre: Floats, pitch_px: float) -> Flags:
    """Return which centres (m, 2) belong to the largest group of close neighbours, or touch it.

    Reflections and dust beside the skin are few or in a line, and belong to none.
    """
    reach = NEIGHBOURS_WITHIN * pitch_px
    pairs = cKDTree(centre).query_pairs(reach, output_type="ndarray")
    inner = np.bincount(pairs.ravel(), minlength=len(centre)) >= NEIGHBOURS_LEAST
    if not inner.any():
        return np.ones(len(centre), bool)
    among = pairs[inner[pairs].all(axis=1)]
    graph = coo_matrix((np.ones(len(among)), among.T), (len(centre), len(centre)))
    group = np.where(inner, connected_components(graph, directed=False)[1], -1)
    own = group == np.bincount(group[inner]).argmax()
    near = pairs[own[pairs].any(axis=1)]
    own[near.ravel()] = True
    return np.asarray(own)


def _spread(values: ArrayLike) -> float:
    low, middle, high = np.percentile(np.asarray(values, np.float64), [16, 50, 84])
    return float((high - low) / 2 / middle)


# Markers found again where a contact hides them, by those of the reference around them.

# Area of a marker over that without contact, between which it counts as seen.
_AREA_FROM, _AREA_TO = 0.65, 1.55
# Largest distance of a seen marker from where its neighbours predict it [pitch].
_ASTRAY = 0.1
# Half the side of the compared squares, and largest distance looked for [pitch].
_HALF, _SEARCH = 0.42, 0.3
# Least likeness of a marker that is found again. Of 26 markers hidden under the contacts of three
# pictures of a GelSlim, 25 reach 0.67.
LIKENESS = 0.6
# Loss of likeness at the distance _HALF from the predicted position: of two alike, the nearer.
_FAR = 0.25
# Largest fraction of a marker found again that another marker covers.
_COVERED = 0.3


class ReferenceMarkers:
    """The markers of a picture without contact, found again in others."""

    def __init__(self, segmenter: Segmenter, detector: Hat, reference: Picture) -> None:
        """Index the markers of a reference, a view without contact (480, 640, 3).

        `detector` looks for hidden markers.
        """
        self._segmenter, self._detector = segmenter, detector
        self._patches = _Patches(segmenter.mask_of_view(reference))
        self._contrast = self._of(reference)
        self._tracker = Tracker(self._patches.centre)
        self._pitch = self._tracker.gate_px / GATE

    def mask_of_view(self, view: Picture) -> Mask:
        """Return the mask (480, 640) of a view, with the markers that were found again."""
        mask = self._segmenter.mask_of_view(view)
        patches = _Patches(mask)
        if not len(patches.number):
            return mask
        moved, visible, own = self._matched(patches)
        hidden = np.flatnonzero(~visible)
        if not len(hidden) or not visible.any():
            return mask
        expected = self._tracker.by_neighbours(moved, visible)
        contrast = self._of(view)
        owns = np.zeros(int(patches.labels.max()) + 1, np.bool_)
        owns[patches.number[own[visible]]] = True
        wrong = np.zeros(len(owns), np.bool_)
        again: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
        for marker in hidden.tolist():
            shift = self._recovered_shift(marker, contrast, expected[marker])
            if shift is None:
                continue
            pixels = self._patches.shifted(marker, shift)
            covering = patches.labels[pixels]
            if owns[covering].mean() > _COVERED:
                continue
            wrong[covering] = True
            again.append(pixels)
        wrong &= ~owns
        mask &= ~wrong[patches.labels]
        for pixels in again:
            mask[pixels] = True
        return mask

    def _of(self, view: Picture) -> NDArray[np.float32]:
        """Return the contrast of luma: coloured shadows change it least in shape."""
        detector = self._detector
        soft = np.asarray(cv2.GaussianBlur(view, (3, 3), 0), np.uint8)
        return hat_contrast(soft, detector.size_px, "grey", bright=detector.bright)

    def _matched(self, patches: _Patches) -> tuple[Floats, Flags, NDArray[np.int64]]:
        """Return displacements (m, 2), True for markers that were seen (m,), and their patches."""
        self._tracker.restart()
        assigned = self._tracker.step(patches.centre).assigned
        visible = assigned >= 0
        moved = np.where(visible[:, None], patches.centre[assigned] - self._patches.centre, 0.0)
        ratio = patches.area[assigned] / self._patches.area
        visible &= (ratio > _AREA_FROM) & (ratio < _AREA_TO)
        for _ in range(2):
            expected = self._tracker.by_neighbours(moved, visible)
            astray = np.linalg.norm(moved - expected, axis=1)
            visible &= astray < _ASTRAY * self._pitch
        return moved, visible, assigned

    def _recovered_shift(
        self, marker: int, contrast: NDArray[np.float32], expected: Floats
    ) -> tuple[int, int] | None:
        """Return the shift (columns, rows) of a marker that is as likely as `LIKENESS`."""
        half, search = round(_HALF * self._pitch), round(_SEARCH * self._pitch)
        column, row = np.round(self._patches.centre[marker]).astype(int)
        right, down = np.round(expected).astype(int)
        own = _square(self._contrast, column, row, half)
        near = _square(contrast, column + right, row + down, half + search)
        if own is None or near is None:
            return None
        likeness = cv2.matchTemplate(near, own, cv2.TM_CCOEFF_NORMED)
        away = np.arange(-search, search + 1) / half
        chosen = likeness - _FAR * (away[:, None] ** 2 + away**2)
        peak = np.unravel_index(int(chosen.argmax()), chosen.shape)
        if likeness[peak] < LIKENESS:
            return None
        return int(right + peak[1] - search), int(down + peak[0] - search)


def with_reference(segmenter: Segmenter, reference: Picture) -> Segmenter | ReferenceMarkers:
    """Return a maker of masks by a reference, a view (480, 640, 3) of `Segmenter.view`."""
    for detector in segmenter.preset.detectors:
        if isinstance(detector, Hat) and detector.lattice:
            return ReferenceMarkers(segmenter, detector, reference)
    return segmenter


class _Patches:
    """Patches of a mask (480, 640)."""

    def __init__(self, mask: Mask) -> None:
        _, labels, stats, centre = cv2.connectedComponentsWithStats(
            mask.view(np.uint8), connectivity=4
        )
        self.labels = np.asarray(labels)
        area = stats[:, cv2.CC_STAT_AREA].astype(np.int64)
        self.number = np.flatnonzero((area >= SMALLEST_PX) & (np.arange(len(area)) > 0))
        self.centre: Floats = np.asarray(centre, np.float64)[self.number]
        self.area = area[self.number]
        self._box = stats[self.number, : cv2.CC_STAT_AREA]

    def shifted(
        self, index: int, shift: tuple[int, int]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return rows and columns of a patch, shifted by columns and rows, within the mask."""
        left, top, width, height = self._box[index].tolist()
        part = self.labels[top : top + height, left : left + width] == self.number[index]
        row, column = np.nonzero(part)
        row, column = row + top + shift[1], column + left + shift[0]
        height, width = self.labels.shape
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        return row[inside], column[inside]


def _square(
    values: NDArray[np.float32], column: int, row: int, half: int
) -> NDArray[np.float32] | None:
    """Return the square around a pixel; None if it is cut by the border."""
    height, width = values.shape
    if not (half <= column < width - half and half <= row < height - half):
        return None
    return values[row - half : row + half + 1, column - half : column + half + 1]
