"""Follows markers through a sequence: named by the reference, lost, and found again.

Each frame, every marker is looked for where it is expected: where it was, moved on at its last
speed; one that is lost, where its neighbours say. Markers and what was found are assigned to each
other with the least sum of distances (Kuhn, 1955; Jonker and Volgenant, 1987), none farther than
the gate. Neighbours then say anew where each should be, and it is done again: a marker that moved
too far to be recognised alone is recognised by the company that it keeps. In a regular pattern that
ends at three quarters of a pitch from one frame to the next; a sequence may go on for any length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from learning.errors import LearningError

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

# Markers around one that are asked where it is.
NEIGHBOURS = 8
# Assignments of a frame, at most.
ROUNDS = 4
_FAR = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """All markers of the reference in one frame."""

    place: Floats
    """Column and row (m, 2) [px]; NaN where a marker is lost."""
    expected: Floats
    """Where each was looked for (m, 2) [px], lost ones too."""
    found: Indices
    """Which of the centres that were given it is (m,); -1 where it is lost."""

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Which markers are lost (m,)."""
        return self.found < 0


class Tracker:
    """Follows the markers of one reference."""

    def __init__(self, reference: Floats, *, gate: float = 0.5, speed: float = 0.5) -> None:
        """Name the markers by their order in the reference.

        Args:
            reference: Column and row (m, 2) of the untouched markers [px].
            gate: How far from where it is expected a marker may be found [pitch]: half the
                distance to a neighbour, beyond which it could be either.
            speed: Share of the last frame's motion that is expected to go on, 0 to 1.

        Raises:
            LearningError: No markers, places that are not finite, or a gate or speed out of range.
        """
        self.reference = np.array(reference, np.float64)
        if self.reference.ndim != 2 or self.reference.shape[1:] != (2,) or not len(self.reference):
            raise LearningError(
                f"reference: found shape {self.reference.shape}; allowed: (m, 2), m 1 or more"
            )
        if not np.isfinite(self.reference).all():
            raise LearningError("reference: found NaN or infinity; allowed: finite places")
        if not 0 < gate <= 1 or not 0 <= speed <= 1:
            raise LearningError(
                f"gate, speed: found {gate}, {speed}; allowed: above 0 to 1, 0 to 1"
            )
        count = min(NEIGHBOURS + 1, len(self.reference))
        distance, around = cKDTree(self.reference).query(self.reference, count)
        distance, self._around = distance.reshape(-1, count), around.reshape(-1, count)
        pitch = np.median(distance[:, 1]) if count > 1 else 40.0
        self.gate_px = float(gate * pitch)
        self._speed = speed
        self.restart()

    def restart(self) -> None:
        """Forget the sequence: the next frame is expected to look like the reference."""
        self._moved = np.zeros_like(self.reference)
        self._step = np.zeros_like(self.reference)
        self._fresh = np.ones(len(self.reference), bool)

    def step(self, centres: Floats) -> Track:
        """Find the markers among the centres (n, 2) of the next frame [px].

        Raises:
            LearningError: Not (n, 2), or places that are not finite.
        """
        centres = np.asarray(centres, np.float64).reshape(-1, 2) if len(centres) == 0 else centres
        if centres.ndim != 2 or centres.shape[1] != 2 or not np.isfinite(centres).all():
            raise LearningError(f"centres: found shape {centres.shape}; allowed: finite (n, 2)")
        before = self._moved
        moved = before + self._speed * np.where(self._fresh[:, None], self._step, 0.0)
        if not self._fresh.all():
            # Lost markers have no speed of their own: they go where their neighbours go.
            moved = np.where(self._fresh[:, None], moved, self._neighbourly(moved, self._fresh))
        found = self._assigned(moved, centres)
        for _ in range(ROUNDS - 1):
            known = found >= 0
            if known.all() or not known.any():
                break
            place = np.where(known[:, None], centres[found] - self.reference, moved)
            moved = self._neighbourly(place, known)
            again = self._assigned(moved, centres)
            if np.array_equal(again, found) or np.sum(again >= 0) < np.sum(known):
                break
            found = again
        known = found >= 0
        now = np.where(
            known[:, None], centres[found] - self.reference if len(centres) else 0.0, moved
        )
        if known.any() and not known.all():
            now = np.where(known[:, None], now, self._neighbourly(now, known))
        both = known & self._fresh
        self._step = np.where(both[:, None], now - before, 0.0)
        self._moved, self._fresh = now, known
        place = np.where(known[:, None], self.reference + now, np.nan)
        return Track(place, self.reference + moved, found)

    def _assigned(self, moved: Floats, centres: Floats) -> Indices:
        """Return which centre is whose (m,), -1 for none."""
        found = np.full(len(self.reference), -1)
        if not len(centres):
            return found
        expected = self.reference + moved
        distance = np.linalg.norm(expected[:, None] - centres[None], axis=-1)
        cost = np.where(distance <= self.gate_px, distance, _FAR)
        ours, theirs = linear_sum_assignment(cost)
        near = cost[ours, theirs] < _FAR
        found[ours[near]] = theirs[near]
        return found

    def _neighbourly(self, moved: Floats, known: NDArray[np.bool_]) -> Floats:
        """Return how far each moved (m, 2) by the median of those around it that are known."""
        values = np.where(known[:, None], moved, np.nan)[self._around]
        some = known[self._around].any(axis=1)
        median = moved.copy()
        if some.any():
            median[some] = np.nanmedian(values[some], axis=1)
        if not some.all() and known.any():
            # Nobody around is known: the nearest that is.
            lonely = np.flatnonzero(~some)
            known_rows = np.flatnonzero(known)
            _, nearest = cKDTree(self.reference[known_rows]).query(self.reference[lonely])
            median[lonely] = moved[known_rows[nearest]]
        return median
