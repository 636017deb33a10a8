"""Tracking of markers through a sequence, by the reference's markers; lost ones are recovered.

In each frame, a marker is expected at its last position plus its last velocity times a factor, or
less it, at its last position, or at its position without contact. Markers and detections are
assigned with the least sum of distances (Kuhn, 1955; Jonker and Volgenant, 1987), none beyond the
gate. Parts that move unlike their neighbours are matched again from the rest inwards, so a marker
that moved too far to be matched alone is matched by its neighbours. Of several solutions the one
that matches most markers holds; where others match as many and differ, a marker is lost, as it
could be either. A sequence can have any length.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from learning.errors import LearningError

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

# Largest distance of a marker from its expected position [pitch]: half the distance to a neighbour,
# beyond which it could be either.
GATE = 0.5
# Fraction of the last frame's motion that is expected to continue.
SPEED = 0.5
# Number of neighbours that predict a marker's position.
NEIGHBOURS = 8
# Largest difference of the displacements of neighbours, over their distance.
SMOOTH = 0.4
# Parts of one assignment that the rest is matched from.
PARTS = 3
# Matched markers by which another solution may fall short and still count as likely.
AS_MANY = 1
# Roughness of another solution over that of the best one, up to which it counts as likely.
AS_ROUGH = 1.5
_FAR = 1e6


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """All markers of the reference in one frame."""

    place: Floats
    """Column and row (m, 2) [px]; NaN if a marker is lost."""
    expected: Floats
    """Expected position of each marker (m, 2) [px], including lost ones."""
    assigned: Indices
    """Index of each marker among the given centres (m,); -1 if it is lost."""

    @property
    def lost(self) -> NDArray[np.bool_]:
        """True for lost markers (m,)."""
        return self.assigned < 0


class Tracker:
    """Follows the markers of one reference."""

    def __init__(self, reference: Floats) -> None:
        """Index the markers (m, 2), column and row [px], by their order in the reference."""
        self.reference = np.array(reference, np.float64)
        if self.reference.ndim != 2 or self.reference.shape[1:] != (2,) or not len(self.reference):
            raise LearningError(
                f"reference: found shape {self.reference.shape}; allowed: (m, 2), m 1 or more"
            )
        if not np.isfinite(self.reference).all():
            raise LearningError("reference: found NaN or infinity; allowed: finite places")
        count = min(NEIGHBOURS + 1, len(self.reference))
        distance, around = cKDTree(self.reference).query(self.reference, count)
        distance, around = distance.reshape(-1, count), around.reshape(-1, count)
        pitch = np.median(distance[:, 1]) if count > 1 else 40.0
        self.gate_px = float(GATE * pitch)
        self._around, self._distance = around[:, 1:], distance[:, 1:]
        own = np.repeat(np.arange(len(around)), count - 1)
        self._edges = np.stack([own, self._around.ravel()], axis=1)
        self._length = self._distance.ravel()
        self.restart()

    def restart(self) -> None:
        """Reset the sequence: the next frame is expected to look like the reference."""
        self._moved = np.zeros_like(self.reference)
        self._step = np.zeros_like(self.reference)
        self._fresh = np.ones(len(self.reference), bool)

    def step(self, centres: Floats) -> Track:
        """Find the markers among the centres (n, 2) of the next frame [px]."""
        centres = np.asarray(centres, np.float64).reshape(-1, 2) if len(centres) == 0 else centres
        if centres.ndim != 2 or centres.shape[1] != 2 or not np.isfinite(centres).all():
            raise LearningError(f"centres: found shape {centres.shape}; allowed: finite (n, 2)")
        before = self._moved
        moved = before + SPEED * np.where(self._fresh[:, None], self._step, 0.0)
        if not self._fresh.all():
            # Lost markers have no velocity: they move with their neighbours.
            moved = np.where(self._fresh[:, None], moved, self.by_neighbours(moved, self._fresh))
        back = 2 * before - moved
        assigned = self._likeliest((moved, before, back, np.zeros_like(before)), centres)
        matched = assigned >= 0
        now = np.where(
            matched[:, None], centres[assigned] - self.reference if len(centres) else 0.0, moved
        )
        if matched.any() and not matched.all():
            now = np.where(matched[:, None], now, self.by_neighbours(now, matched))
            moved = np.where(matched[:, None], moved, now)
        both = matched & self._fresh
        self._step = np.where(both[:, None], now - before, 0.0)
        self._moved, self._fresh = now, matched
        position = np.where(matched[:, None], self.reference + now, np.nan)
        return Track(position, self.reference + moved, assigned)

    def _likeliest(self, expected: Sequence[Floats], centres: Floats) -> Indices:
        """Return the centre of each marker (m,), -1 for none, by the likeliest solution.

        Expected displacements (m, 2) come with the likeliest first; centres are (n, 2).
        """
        solutions: list[Indices] = []
        if not len(centres):
            return np.full(len(self.reference), -1)
        for moved in expected:
            assigned = self._assigned(moved, centres)
            parts = self._parts(assigned, centres)
            if not solutions and len(parts) == 1 and parts[0].all():
                return assigned
            grown = (self._grown(np.where(part, assigned, -1), centres) for part in parts)
            solutions += [self._polished(one, centres) for one in (assigned, *grown)]
        counts, rough = zip(*(self._quality(one, centres) for one in solutions), strict=True)
        best = min(range(len(solutions)), key=lambda one: (-counts[one], rough[one]))
        chosen = solutions[best]
        for other, count, roughness in zip(solutions, counts, rough, strict=True):
            if count >= counts[best] - AS_MANY and roughness <= AS_ROUGH * rough[best]:
                chosen = np.where((other >= 0) & (chosen != other), -1, chosen)
        return chosen

    def _changes(self, assigned: Indices, centres: Floats) -> tuple[Indices, Floats]:
        """Return matched neighbours (k, 2), and the change of displacement over distance (k,)."""
        both = (assigned[self._edges] >= 0).all(axis=1)
        pairs = self._edges[both]
        moved = centres[assigned] - self.reference
        change = np.linalg.norm(moved[pairs[:, 0]] - moved[pairs[:, 1]], axis=1)
        return pairs, change / self._length[both]

    def _quality(self, assigned: Indices, centres: Floats) -> tuple[int, float]:
        """Return the size of the largest smooth part of a solution, and its roughness."""
        _, change = self._changes(assigned, centres)
        size = max((int(part.sum()) for part in self._parts(assigned, centres)), default=0)
        return size, float(np.sqrt((change**2).mean())) if len(change) else 0.0

    def _parts(self, assigned: Indices, centres: Floats) -> list[NDArray[np.bool_]]:
        """Return the largest parts that move smoothly, as flags of their markers (m,)."""
        matched = assigned >= 0
        if not matched.any():
            return []
        pairs, change = self._changes(assigned, centres)
        first, second = pairs[change <= SMOOTH].T
        graph = coo_array((np.ones(len(first), np.int8), (first, second)), 2 * assigned.shape)
        _, label = connected_components(graph, directed=False)
        sizes = np.bincount(label[matched], minlength=int(label.max()) + 1)
        largest = np.argsort(-sizes, kind="stable")[:PARTS]
        return [matched & (label == number) for number in largest if sizes[number]]

    def _grown(self, assigned: Indices, centres: Floats) -> Indices:
        """Match the neighbours of matched markers, the closest to expectations first."""
        assigned, gate = assigned.copy(), self.gate_px / 2
        while True:
            matched = assigned >= 0
            rows = np.flatnonzero(~matched & matched[self._around].any(axis=1))
            free = np.setdiff1d(np.arange(len(centres)), assigned[matched])
            if not len(rows) or not len(free):
                return assigned
            moved = np.where(matched[:, None], centres[assigned] - self.reference, 0.0)
            expected = self.reference[rows] + self._extrapolated(moved, matched, rows)
            distance = np.linalg.norm(expected[:, None] - centres[free][None], axis=-1)
            nearest = distance.argmin(axis=1)
            mutual = distance.argmin(axis=0)[nearest] == np.arange(len(rows))
            close = mutual & (distance[np.arange(len(rows)), nearest] <= gate)
            if close.any():
                assigned[rows[close]] = free[nearest[close]]
            elif gate < self.gate_px:
                gate = self.gate_px
            else:
                return assigned

    def _polished(self, assigned: Indices, centres: Floats) -> Indices:
        """Assign all markers again by the median of their neighbours, while that matches more."""
        while (matched := assigned >= 0).any() and not matched.all():
            moved = np.where(matched[:, None], centres[assigned] - self.reference, 0.0)
            again = self._assigned(self.by_neighbours(moved, matched), centres)
            if np.sum(again >= 0) <= matched.sum():
                break
            assigned = again
        return assigned

    def _extrapolated(self, moved: Floats, matched: NDArray[np.bool_], rows: Indices) -> Floats:
        """Return displacements (k, 2) of markers, linear in those of their matched neighbours."""
        around = self._around[rows]
        weight = matched[around].astype(np.float64)
        away = (self.reference[around] - self.reference[rows][:, None]) / self.gate_px
        ones = np.ones((*away.shape[:2], 1))
        design = np.concatenate([ones, away], axis=2) * weight[..., None]
        # A little stiffness keeps slopes small that few neighbours tell.
        square = design.transpose(0, 2, 1) @ design + np.diag([1e-6, 1.0, 1.0])
        right = design.transpose(0, 2, 1) @ (moved[around] * weight[..., None])
        return np.asarray(np.linalg.solve(square, right)[:, 0])

    def _assigned(self, moved: Floats, centres: Floats) -> Indices:
        """Return the centre assigned to each marker (m,), -1 for none."""
        assigned = np.full(len(self.reference), -1)
        if not len(centres):
            return assigned
        expected = self.reference + moved
        distance = np.linalg.norm(expected[:, None] - centres[None], axis=-1)
        cost = np.where(distance <= self.gate_px, distance, _FAR)
        ours, theirs = linear_sum_assignment(cost)
        near = cost[ours, theirs] < _FAR
        assigned[ours[near]] = theirs[near]
        return assigned

    def by_neighbours(self, moved: Floats, matched: NDArray[np.bool_]) -> Floats:
        """Return the displacement of each marker (m, 2) by the median of its matched neighbours."""
        values = np.where(matched[:, None], moved, np.nan)[self._around]
        some = matched[self._around].any(axis=1)
        median = moved.copy()
        if some.any():
            median[some] = np.nanmedian(values[some], axis=1)
        if not some.all() and matched.any():
            # No neighbour is matched: use the nearest matched marker.
            lonely = np.flatnonzero(~some)
            matched_rows = np.flatnonzero(matched)
            _, nearest = cKDTree(self.reference[matched_rows]).query(self.reference[lonely])
            median[lonely] = moved[matched_rows[nearest]]
        return median
