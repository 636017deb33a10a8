"""A signed distance known at the nodes of a grid, and smooth in between: tricubic B-splines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.indenters.part import Bounds

Array = NDArray[np.float64]

FLAT = 1e-6
"""Gradients shorter than this have no direction."""
AT_ONCE = 1 << 18
"""Points that are looked up together: their numbers then stay in the processor's cache."""


@dataclass(frozen=True, slots=True)
class Grid:
    """Nodes at whole multiples of a spacing, so that x = 0 and y = 0 hold some of them."""

    first: tuple[int, int, int]
    """Multiple at which the first node stands, along x, y and z."""
    shape: tuple[int, int, int]
    spacing: float
    """[m]."""

    @property
    def count(self) -> int:
        """Number of nodes."""
        return int(np.prod(self.shape))

    def places(self, nodes: NDArray[np.int64]) -> Array:
        """Where nodes (..., 3), counted from 0, stand (..., 3) [m]."""
        places: Array = (nodes + np.array(self.first)) * self.spacing
        return places

    def points(self) -> Array:
        """Where all nodes stand (count, 3) [m], z fastest."""
        return self.places(np.indices(self.shape).reshape(3, -1).T)


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """The distance as a spline: twice differentiable, so that its normal turns smoothly.

    Beyond the sides of the grid and below it the distance goes on along the gradient at its
    border; above it the body goes on straight up.
    """

    grid: Grid
    coefficients: Array
    """Of the B-splines, one a node (grid.shape) [m]."""
    drop: float
    """How much lower than the grid says everything stands [m]."""
    bounds: Bounds
    """A box around the body [m]."""
    notes: tuple[str, ...] = ()
    """What the making of it did to the body."""

    def distance(self, points: Array) -> tuple[Array, Array]:
        """Gap (N,) [m] and unit normal (N, 3) at points (N, 3) [m]."""
        gap, normal = np.empty(len(points)), np.empty((len(points), 3))
        for first in range(0, len(points), AT_ONCE):
            some = slice(first, first + AT_ONCE)
            gap[some], normal[some] = self._distance(points[some])
        return gap, normal

    @property
    def origin(self) -> Array:
        """Where the first node stands (3,) [m]."""
        return np.array(self.grid.first) * self.grid.spacing - [0.0, 0.0, self.drop]

    def _distance(self, points: Array) -> tuple[Array, Array]:
        spacing = self.grid.spacing
        place = (points - self.origin) / spacing
        held = np.clip(place, 1.0, np.array(self.grid.shape) - 3.0)
        beyond = (place - held) * spacing
        beyond[:, 2] = np.minimum(beyond[:, 2], 0.0)
        node = held.astype(np.int64)
        weight, slope = _weights((held - node).T)
        _, ny, nz = self.grid.shape
        start = ((node[:, 0] - 1) * ny + node[:, 1] - 1) * nz + node[:, 2] - 1
        flat = self.coefficients.ravel()
        gap = np.zeros(len(points))
        gradient = np.zeros((3, len(points)))
        for i in range(4):
            for j in range(4):
                value, upward = np.zeros((2, len(points)))
                for k in range(4):
                    taken = flat.take(start + ((i * ny + j) * nz + k))
                    value += weight[k][2] * taken
                    upward += slope[k][2] * taken
                across = weight[i][0] * weight[j][1]
                gap += across * value
                gradient[0] += slope[i][0] * weight[j][1] * value
                gradient[1] += weight[i][0] * slope[j][1] * value
                gradient[2] += across * upward
        steepness = np.linalg.norm(gradient, axis=0)
        some = steepness > FLAT * spacing
        normal = np.where(some, gradient / np.where(some, steepness, 1.0), [[0.0], [0.0], [-1.0]]).T
        return gap + np.einsum("ij,ij->i", normal, beyond), normal


def coefficients(values: Array) -> Array:
    """Coefficients of the spline that has these values at the nodes."""
    from scipy.ndimage import spline_filter

    found: Array = spline_filter(values, order=3, output=np.float64, mode="mirror")
    return found


def _weights(share: Array) -> tuple[list[Array], list[Array]]:
    """The four cubic B-splines over a cell and their derivatives, at `share` of its width.

    De Boor, A Practical Guide to Splines (1978), chapter X, for even knots.
    """
    left = 1 - share
    weight = [
        left**3 / 6,
        (4 + share * share * (3 * share - 6)) / 6,
        (4 + left * left * (3 * left - 6)) / 6,
        share**3 / 6,
    ]
    slope = [
        -left * left / 2,
        share * (3 * share - 4) / 2,
        -left * (3 * left - 4) / 2,
        share * share / 2,
    ]
    return weight, slope
