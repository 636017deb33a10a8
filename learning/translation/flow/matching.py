"""Which marker of the untouched sensor is which of a frame, alone or along a press.

Each marker is looked for where the spline says: at first where it was in the frame before, moved
on at half its last speed, or where it lies untouched. Those that are each other's nearest, within
half a pitch, are taken to be the same; one that the others would not have expected within half a
pitch is let go; the spline through the rest says anew where each should be, and it is done again.
Discs that grew together are cut where they meet.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from learning.errors import LearningError
from learning.markers.centres import Centres, find_centres
from learning.translation.flow.spline import Chosen, Floats, Spline, pitch
from recorder.markers import SMALLEST_PX

Masks = NDArray[np.bool_]
Indices = NDArray[np.int64]

ROUNDS = 5
"""Times that markers are looked for in a frame, at most."""
GATE = 0.5
"""How far from where it is expected a marker may be found [pitch]: beyond half of it, it could as
well be its neighbour."""
SPEED = 0.5
"""Share of the last frame's motion that is expected to go on."""
MERGED = 1.5
"""Patches so many times as large as a marker may be, and larger, are two that grew together."""
_CUTS = 6  # rounds of cutting a patch in parts
_LONE_PITCH = 80.0  # px, of a single marker


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """The markers of the untouched sensor in one frame."""

    moved: Floats
    """How far each moved (m, 2) [px]; of lost ones what the spline says."""
    growth: Floats
    """Logarithm of each one's area over its area untouched (m,); of lost ones likewise."""
    known: Chosen
    """Which were found (m,)."""


class Matcher:
    """Finds the markers of one untouched sensor in frames; remembers the frame before."""

    def __init__(
        self, reference: Masks, *, smoothing: float, smallest_px: int = SMALLEST_PX
    ) -> None:
        """Name the markers by their order in the reference.

        Args:
            reference: The untouched mask (480, 640).
            smoothing: Of the spline.
            smallest_px: Patches of fewer pixels are specks.

        Raises:
            LearningError: No mask, or one without markers.
        """
        found = find_centres(reference, smallest_px=smallest_px)
        # The centre of a marker that the border cuts moves as it is cut: it would mislead.
        chosen = found.whole if found.whole.any() else np.ones(len(found), np.bool_)
        if not chosen.any():
            raise LearningError(f"reference: found no marker of {smallest_px} px or more")
        self.markers: Floats = found.place[chosen]
        self.area = found.area[chosen].astype(np.float64)
        self.spline = Spline(self.markers, smoothing=smoothing)
        self.pitch_px = pitch(self.markers) or _LONE_PITCH
        self._smallest_px = smallest_px
        self._all_cut = not found.whole.any()
        self.restart()

    def restart(self) -> None:
        """Forget the frame before: the next is expected to look like the reference."""
        self._before = np.zeros_like(self.markers)
        self._step = np.zeros_like(self.markers)

    def step(self, mask: Masks) -> Match:
        """Return the markers in the next frame (480, 640)."""
        seen = find_centres(mask, smallest_px=self._smallest_px)
        start = self._before + SPEED * self._step
        moved, found = self._searched(start, seen)
        if not (found >= 0).all() and len(seen):
            cut = self._cut(mask, seen, self.markers + moved)
            if cut is not None:
                seen = cut
                moved, found = self._searched(moved, seen)
        known = found >= 0
        self._step, self._before = moved - self._before, moved
        growth = np.zeros((len(self.markers), 1))
        growth[known, 0] = np.log(seen.area[found[known]] / self.area[known])
        return Match(moved, self.spline.filled(growth, known)[:, 0], known)

    def _searched(self, start: Floats, seen: Centres) -> tuple[Floats, Indices]:
        """Return how far all markers moved (m, 2), and which of those seen each is (m,) or -1."""
        usable = np.flatnonzero(seen.whole | self._all_cut)
        places = seen.place[usable]
        moved, found = start, np.full(len(self.markers), -1)
        if not len(places):
            return moved, found
        tree = cKDTree(places)
        for _ in range(ROUNDS):
            again = self._nearest(self.markers + moved, places, tree)
            offset = np.where(again[:, None] >= 0, places[again] - self.markers, 0.0)
            again, moved = self._agreed(again, offset, start)
            if np.array_equal(again, found):
                break
            found = again
        return moved, np.where(found >= 0, usable[found], -1)

    def _nearest(self, expected: Floats, places: Floats, tree: cKDTree) -> Indices:
        """Return the place that is each marker's nearest, and whose nearest it is (m,), or -1."""
        apart, nearest = tree.query(expected)
        _, back = cKDTree(expected).query(places)
        mine = (back[nearest] == np.arange(len(expected))) & (apart <= GATE * self.pitch_px)
        return np.where(mine, nearest, -1)

    def _agreed(self, found: Indices, offset: Floats, start: Floats) -> tuple[Indices, Floats]:
        """Return the matches that agree with each other, and the motion of all markers by them."""
        found = found.copy()
        while True:
            known = found >= 0
            moved = self._completed(offset, known, start)
            surprise = np.where(known, self.spline.surprise(moved), 0.0)
            worst = int(surprise.argmax())
            if surprise[worst] <= GATE * self.pitch_px:
                return found, moved
            found[worst] = -1

    def _completed(self, offset: Floats, known: Chosen, start: Floats) -> Floats:
        if known.all():
            return offset
        # What is lost goes on as it was expected to, but for what the others did beyond that.
        return start + self.spline.filled(offset - start, known)

    def _cut(self, mask: Masks, seen: Centres, expected: Floats) -> Centres | None:
        """Return what is seen with patches cut that several markers are expected in; None: none."""
        large = MERGED * float(np.median(self.area))
        if not (seen.area > large).any():
            return None
        _, labels, stats, middle = cv2.connectedComponentsWithStats(
            mask.view(np.uint8), connectivity=4
        )
        height, width = mask.shape
        column, row = np.rint(expected).astype(np.int64).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        at = np.zeros(len(expected), np.int64)
        at[inside] = labels[row[inside], column[inside]]
        claims = np.bincount(at, minlength=len(stats))
        merged = (claims > 1) & (stats[:, cv2.CC_STAT_AREA] > large)
        merged[0] = False
        place, area, whole = list(seen.place), list(seen.area), list(seen.whole)
        gone: list[int] = []
        for label in np.flatnonzero(merged).tolist():
            left, top, wide, high, _ = stats[label]
            rows, columns = np.nonzero(labels[top : top + high, left : left + wide] == label)
            pixels = np.stack([columns + left, rows + top], axis=1).astype(np.float64)
            parts, sizes = _parted(pixels, expected[at == label])
            one = int(np.linalg.norm(seen.place - middle[label], axis=1).argmin())
            gone.append(one)
            place += list(parts)
            area += sizes
            whole += [bool(seen.whole[one])] * len(parts)
        if not gone:
            return None
        kept = np.ones(len(place), np.bool_)
        kept[gone] = False
        return Centres(np.array(place)[kept], np.array(area, np.int64)[kept], np.array(whole)[kept])


def _parted(pixels: Floats, claims: Floats) -> tuple[Floats, list[int]]:
    """Return centres (k, 2) and sizes of the parts of a patch, one about each claim (k-means)."""
    centres = claims.copy()
    for _ in range(_CUTS):
        apart = ((pixels[:, None] - centres[None]) ** 2).sum(axis=-1)
        owner = apart.argmin(axis=1)
        sizes = np.bincount(owner, minlength=len(centres))
        for one in np.flatnonzero(sizes):
            centres[one] = pixels[owner == one].mean(axis=0)
    taken = np.flatnonzero(sizes)
    return centres[taken], sizes[taken].tolist()
