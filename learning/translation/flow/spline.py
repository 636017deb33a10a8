"""A smooth field through the displacements of markers: the thin-plate spline (Duchon, 1977).

Of all fields that take given values at the markers it is the one that bends least. Since markers
are named by where they lie untouched, the knots are the same in all frames: value anywhere, energy
of bending, and what a marker should have done by the others, are each one matrix per reference.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Chosen = NDArray[np.bool_]

_RIDGE = 1e-6
"""Share of the stiffness that holds on to nothing: without it a field that no marker pins down in
some direction (fewer than three, or all on one line) would be any."""
_AFFINE_FROM = 6
"""So many markers are needed before the field may grow linearly beyond them."""


class Spline:
    """Splines with knots at one set of markers."""

    def __init__(self, knots: Floats, *, smoothing: float = 0.0) -> None:
        """Prepare the matrices.

        Args:
            knots: Column and row of the untouched markers (m, 2) [px], m 1 or more.
            smoothing: How much a field may miss the markers' displacements to bend less, of the
                kernel at the distance of neighbours; 0 goes through them.
        """
        self.knots = np.asarray(knots, np.float64)
        count = len(self.knots)
        self._middle = self.knots.mean(axis=0)
        self._unit = max(pitch(self.knots), 1.0)
        rank = 3 if count >= _AFFINE_FROM and _spread(self.knots) else 1
        plain, line = self._basis(self.knots, rank)
        system = np.zeros((count + rank, count + rank))
        system[:count, :count] = plain + smoothing * np.eye(count)
        system[:count, count:], system[count:, :count] = line, line.T
        self._solved = np.linalg.inv(system)[:, :count]
        self._rank = rank
        self.energy: Floats = np.array(self._solved[:count])
        """Of bending: d^T energy d for displacements d (m,) of the markers (m, m)."""

    def at(self, places: Floats) -> Floats:
        """Return the matrix (q, m) that takes displacements of the markers to those of places.

        Args:
            places: Column and row in the untouched image (q, 2) [px].
        """
        plain, line = self._basis(places, self._rank)
        return np.asarray(np.concatenate([plain, line], axis=1) @ self._solved, np.float64)

    def filled(self, values: Floats, known: Chosen) -> Floats:
        """Return values (m, k) of which the unknown ones bend the field least.

        Args:
            values: One row a marker; those of unknown ones are not looked at.
            known: Which of them are known (m,).
        """
        if known.all():
            return values
        lost = ~known
        held = self.energy[np.ix_(lost, lost)]
        ridge = max(_RIDGE * float(np.trace(self.energy)) / len(self.knots), _RIDGE)
        pull = -self.energy[np.ix_(lost, known)] @ values[known]
        whole = np.array(values)
        whole[lost] = np.linalg.solve(held + ridge * np.eye(len(held)), pull)
        return whole

    def surprise(self, values: Floats) -> Floats:
        """Return how far each value is from what the others say of it (m,) [that of values].

        The error of leaving one out, in closed form: what the spline through all others would give
        at a knot differs from the value there by (E d)_i / E_ii.

        Args:
            values: Of all markers (m, k).
        """
        own = np.maximum(np.diagonal(self.energy), np.finfo(np.float64).tiny)
        return np.asarray(np.linalg.norm((self.energy @ values) / own[:, None], axis=1))

    def _basis(self, places: Floats, rank: int) -> tuple[Floats, Floats]:
        """Return kernel (q, m) and polynomials (q, rank) at places (q, 2)."""
        square = ((places[:, None] - self.knots[None]) ** 2).sum(axis=-1) / self._unit**2
        line = np.ones((len(places), rank))
        if rank == 1:
            # The kernel of a membrane in space: no growth beyond the markers.
            return -np.sqrt(square), line
        line[:, 1:] = (places - self._middle) / self._unit
        return 0.5 * square * np.log(np.maximum(square, 1e-12)), line


def pitch(places: Floats) -> float:
    """Return the median distance of a marker to its nearest neighbour [px]; 0 of a single one."""
    if len(places) < 2:
        return 0.0
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    return float(np.median(apart.min(axis=1)))


def _spread(places: Floats) -> bool:
    """Whether markers spread in two directions, so that a plane through them is one."""
    along = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    return bool(along[-1] > 0.05 * along[0])
