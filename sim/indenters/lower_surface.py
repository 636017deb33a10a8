"""The first crossing of a signed distance along upright columns: heights of a lower surface."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Distance = Callable[[NDArray[np.int64], Array], tuple[Array, Array]]
"""Gap and z of its gradient, in the columns of these numbers at these heights."""

STRIDE = 0.8
"""Share of the gap that a march dares: gaps near rounded edges are exact to first order only."""
TOUCHING = 1e-13
"""Gaps below this are contact [m]."""
SETTLED = 1e-12
"""A crossing is found when it moves by less than this [m]."""


def lower_surface(distance: Distance, count: int, reach: float) -> Array:
    """First height (count,) [m] at which each column, going up from 0, enters the body.

    inf where it stays outside up to `reach`. Each column is marched up by a share of the gap, and
    by 1/2000 of `reach` at least, until it is inside; Newton's method then finds the crossing
    within that bracket, bisecting where Newton leaves it.
    """
    low, high = _bracketed(distance, count, reach)
    return _crossing(distance, low, high)


def _bracketed(distance: Distance, count: int, reach: float) -> tuple[Array, Array]:
    """A height outside the body and one inside it; inf where no height is inside."""
    low, high, height = np.zeros(count), np.full(count, np.inf), np.zeros(count)
    going = np.arange(count)
    while len(going):
        gap, _ = distance(going, height[going])
        inside = gap <= TOUCHING
        high[going[inside]] = height[going[inside]]
        going, gap = going[~inside], gap[~inside]
        low[going] = height[going]
        height[going] += STRIDE * gap + reach / 2000
        going = going[height[going] <= reach]
    return low, high


def _crossing(distance: Distance, low: Array, high: Array) -> Array:
    height = np.where(high > low, (low + high) / 2, high)
    going = np.flatnonzero((high > low) & np.isfinite(high))
    turn = 0
    while len(going):
        here = height[going]
        gap, slope = distance(going, here)
        outside = gap > 0
        low[going[outside]], high[going[~outside]] = here[outside], here[~outside]
        below, above = low[going], high[going]
        falling = slope < 0
        newton = here - gap / np.where(falling, slope, 1.0)
        within = falling & (newton >= below) & (newton <= above)
        turn += 1
        # A bisection now and then, so that a bracket which Newton narrows from one side closes.
        height[going] = np.where(within & (turn % 4 > 0), newton, (below + above) / 2)
        moved = np.abs(height[going] - here)
        settled = (within & (moved < SETTLED)) | (above - below < SETTLED)
        going = going[~settled]
    return height
