"""Tracking of markers through a sequence, by the reference's markers; lost ones are recovered.

In each frame, a marker is expected at its last position plus its last velocity times a factor; a
lost marker is expected where its neighbours predict. Markers and detections are assigned with the
least sum of distances (Kuhn, 1955; Jonker and Volgenant, 1987), none beyond the gate. Then
neighbours predict each marker again, and the assignment is repeated. So a marker that moved too far
to be matched alone is matched by its neighbours. In a regular pattern this fails beyond three
quarters of a pitch between frames; a sequence can have any length.
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

# Number of neighbours that predict a marker's position.
NEIGHBOURS = 8
# Maximum number of assignments per frame.
ROUNDS = 4
_FAR = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """All markers of the reference in one frame."""

    place: Floats
    """Column and row (m, 2) [px]; NaN if a marker is lost."""
    expected: Floats
    """Expected position of each marker (m, 2) [px], including lost ones."""
    found: Indices
    """Index of each marker among the given centres (m,); -1 if it is lost."""

    @property
    def lost(self) -> NDArray[np.bool_]:
        """True for lost markers (m,)."""
        return self.found < 0


class Tracker:
    """Follows the markers of one reference."""

    def __init__(self, reference: Floats, *, gate: float = 0.5, speed: float = 0.5) -> None:
        """Index the markers by their order in the reference.

        Args:
            reference: Column and row (m, 2) of the markers without contact [px].
            gate: Maximum distance of a marker from its expected position [pitch]: half the distance
                to a neighbour, beyond which it could be either.
            speed: Fraction of the last frame's motion that is expected to continue, 0 to 1.

        Raises:
            LearningError: There are no markers, positions are not finite, or gate or speed is out
                of range.
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
        """Reset the sequence: the next frame is expected to look like the reference."""
        self._moved = np.zeros_like(self.reference)
        self._step = np.zeros_like(self.reference)
        self._fresh = np.ones(len(self.reference), bool)

    def step(self, centres: Floats) -> Track:
        """Find the markers among the centres (n, 2) of the next frame [px].

        Raises:
            LearningError: The shape is not (n, 2), or positions are not finite.
        """
        centres = np.asarray(centres, np.float64).reshape(-1, 2) if len(centres) == 0 else centres
        if centres.ndim != 2 or centres.shape[1] != 2 or not np.isfinite(centres).all():
            raise LearningError(f"centres: found shape {centres.shape}; allowed: finite (n, 2)")
        before = self._moved
        moved = before + self._speed * np.where(self._fresh[:, None], self._step, 0.0)
        if not self._fresh.all():
            # Lost markers have no velocity: they move with their neighbours.
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
        """Return the centre assigned to each marker (m,), -1 for none."""
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
        """Return the displacement of each marker (m, 2) by the median of its known neighbours."""
        values = np.where(known[:, None], moved, np.nan)[self._around]
        some = known[self._around].any(axis=1)
        median = moved.copy()
        if some.any():
            median[some] = np.nanmedian(values[some], axis=1)
        if not some.all() and known.any():
            # No neighbour is known: use the nearest known marker.
            lonely = np.flatnonzero(~some)
            known_rows = np.flatnonzero(known)
            _, nearest = cKDTree(self.reference[known_rows]).query(self.reference[lonely])
            median[lonely] = moved[known_rows[nearest]]
        return median
