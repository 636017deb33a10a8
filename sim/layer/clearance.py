"""The gap between the untouched body and the indenter, wherever its tip goes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.indenters import Indenter
from sim.layer.grid import Grid
from sim.motion import Motion

Array = NDArray[np.floating[Any]]

FINENESS = 2
"""Samples of the indenter's lower surface in a pixel's width."""


class Clearance:
    """Heights of an indenter, sampled once, and read between the samples as the tip moves.

    Samples lie under the pixels when the tip is at the motion's first waypoint: a straight press
    reads the samples themselves. In between, the height is the cubic through the 4 x 4 samples
    around, kept within those of the cell; in a cell with a corner that cannot touch, the nearest
    sample's, which keeps a wall's place on average.
    """

    def __init__(self, indenter: Indenter, grid: Grid, motion: Motion) -> None:
        """Sample everything that the motion can bring over the body."""
        body, tip = grid.body, np.asarray(motion.tip)
        self._grid, self._anchor = grid, tip[0]
        self._step = tuple(pixel / FINENESS for pixel in grid.pixel)
        self.surface = body.heights(grid.x, grid.y)
        """Height of the untouched top (nx, ny) [m]."""
        self._cap = 2 * (motion.depth_max - float(self.surface.min())) + body.thickness / 2
        far = tip[:, :2] - self._anchor[:2]
        samples = []
        self._first: list[int] = []
        for axis, centres in enumerate((grid.x, grid.y)):
            low, high = -far[:, axis].max(), -far[:, axis].min()
            first = int(np.floor(low / self._step[axis])) - 2
            last = FINENESS * (len(centres) - 1) + int(np.ceil(high / self._step[axis])) + 3
            offsets = np.arange(first, last + 1) * self._step[axis]
            samples.append(centres[0] - self._anchor[axis] + offsets)
            self._first.append(first)
        heights = indenter.heights(samples[0][:, None], samples[1][None, :], reach=self._cap)
        self._heights = np.minimum(heights, self._cap)

    def at(self, tip: Array) -> Array:
        """The gap at every pixel (nx, ny) with the tip at (3,) [m]; below 0 they overlap."""
        whole, rest = [], []
        for axis in range(2):
            place = (self._anchor[axis] - tip[axis]) / self._step[axis]
            whole.append(int(np.floor(place)) - self._first[axis])
            rest.append(place - np.floor(place))
        gap: Array = self._read(whole, rest) + tip[2] - self.surface
        return gap

    def _read(self, whole: list[int], rest: list[float]) -> Array:
        nx, ny = self._grid.shape

        def sample(i: int, j: int) -> Array:
            return self._heights[_every(whole[0] + i, nx), _every(whole[1] + j, ny)]

        corners = [sample(i, j) for i in (0, 1) for j in (0, 1)]
        low, high = np.minimum.reduce(corners), np.maximum.reduce(corners)
        rows: Array = np.zeros((nx, self._heights.shape[1]))
        for i, weight in enumerate(_weights(rest[0])):
            rows += weight * self._heights[_every(whole[0] + i - 1, nx)]
        cubic: Array = np.zeros((nx, ny))
        for j, weight in enumerate(_weights(rest[1])):
            cubic += weight * rows[:, _every(whole[1] + j - 1, ny)]
        nearest = sample(int(rest[0] >= 0.5), int(rest[1] >= 0.5))
        return np.where(high < self._cap, np.clip(cubic, low, high), nearest)


def _every(first: int, count: int) -> slice:
    """The samples under `count` pixels, the first of them given."""
    return slice(first, first + FINENESS * (count - 1) + 1, FINENESS)


def _weights(rest: float) -> tuple[float, float, float, float]:
    """Lagrange's weights of the samples at -1, 0, 1, 2 for the place `rest`."""
    before, here, after, beyond = rest + 1, rest, rest - 1, rest - 2
    return (
        -here * after * beyond / 6,
        before * after * beyond / 2,
        -before * here * beyond / 2,
        before * here * after / 6,
    )
