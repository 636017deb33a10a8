"""The fine, even grid of material points of a gel's top that images are drawn from."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sim.errors import SceneError, check_range
from sim.scene import Body

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Top:
    """Material points of the untouched top, border to border."""

    x: Array
    """(N,) [m], evenly spaced."""
    y: Array
    """(M,) [m], evenly spaced."""
    height: Array
    """Height of the untouched top at them (N, M) [m]; 0 when flat."""

    @property
    def corner(self) -> tuple[float, float]:
        """Place of the first point, x and y [m]."""
        return float(self.x[0]), float(self.y[0])

    @property
    def step(self) -> tuple[float, float]:
        """Distance of neighbours along x and y [m]."""
        return float(self.x[1] - self.x[0]), float(self.y[1] - self.y[0])


def top_of(body: Body, spacing: float) -> Top:
    """The grid of a body with its points about `spacing` [m] apart.

    Raises:
        SceneError: A spacing out of range.
    """
    check_range("render", "spacing", spacing, 1e-6, min(body.size_x, body.size_y) / 4, unit="m")
    x, y = (
        np.linspace(-size / 2, size / 2, max(2, round(size / spacing) + 1))
        for size in (body.size_x, body.size_y)
    )
    return Top(x, y, heights(body, x[:, None], y[None, :]))


def heights(body: Body, x: Array, y: Array) -> Array:
    """Height of the untouched top at x and y, broadcast together [m]."""
    if body.dome_radius is None:
        return np.zeros(np.broadcast_shapes(x.shape, y.shape))
    each: Array = np.vectorize(body.height, otypes=[float])(x, y)
    return each


# A smooth curve through values at uneven places: weights of four of them, for any place between.
#
# Cubic Hermite pieces whose slope at a place is that of the parabola through it and its neighbours
# (at an end, through the last three): the curve and its slope are continuous, parabolas come out
# exactly, and the curve depends linearly on the values, so its weights are computed once.

# Values that a place depends on.
TAPS = 4


@dataclass(frozen=True, slots=True)
class Taps:
    """Which values places depend on, and how much."""

    first: NDArray[np.int32]
    """The first of four neighbouring values (n,)."""
    weight: NDArray[np.float32]
    """Their weights (n, 4); they sum up to 1."""


def cubic_taps(axis: Array, places: Array, *, name: str = "axis") -> Taps:
    """The taps for places (n,) among values at `axis` (m,), both in the same unit.

    Beyond the ends the curve goes on straight, over one gap between values at most.

    Raises:
        SceneError: Fewer than four values, an axis that does not rise, or places further outside.
    """
    _check(axis, places, name)
    slope = _slopes(axis)
    count = len(axis)
    cell = np.clip(np.searchsorted(axis, places, side="right") - 1, 0, count - 2)
    width = axis[cell + 1] - axis[cell]
    share = (places - axis[cell]) / width
    inside = np.clip(share, 0, 1)
    beyond = (share - inside) * width
    unit = np.eye(count)
    start, end = unit[cell], unit[cell + 1]
    start_slope, end_slope = slope[cell], slope[cell + 1]
    t = inside[:, None]
    weight = (1 + 2 * t) * (1 - t) ** 2 * start + t**2 * (3 - 2 * t) * end
    weight += width[:, None] * t * (1 - t) * ((1 - t) * start_slope - t * end_slope)
    weight += beyond[:, None] * np.where(t < 0.5, start_slope, end_slope)
    first = np.clip(cell - 1, 0, count - TAPS)
    taken = np.take_along_axis(weight, first[:, None] + np.arange(TAPS), axis=1)
    return Taps(first.astype(np.int32), taken.astype(np.float32))


def _slopes(axis: Array) -> Array:
    """Weights (m, m) of the values in the slope at each place."""
    count = len(axis)
    near = np.clip(np.arange(count), 1, count - 2)[:, None] + np.arange(-1, 2)
    three = axis[near]
    one, other = three[:, [1, 0, 0]], three[:, [2, 2, 1]]
    # The derivative of each of Lagrange's parabolas, which are 1 at one of the three places.
    weight = (2 * axis[:, None] - one - other) / ((three - one) * (three - other))
    slope = np.zeros((count, count))
    np.put_along_axis(slope, near, weight, axis=1)
    return slope


def _check(axis: Array, places: Array, name: str) -> None:
    if axis.ndim != 1 or len(axis) < TAPS:
        raise SceneError(f"{name}: shape {axis.shape}; allowed: at least {TAPS} places in a row")
    if not np.isfinite(axis).all() or not all(a < b for a, b in pairwise(axis)):
        raise SceneError(f"{name}: does not rise; allowed: rising, finite places")
    room = axis[1] - axis[0], axis[-1] - axis[-2]
    low, high = axis[0] - room[0], axis[-1] + room[1]
    if places.min() < low or places.max() > high:
        raise SceneError(
            f"{name}: {axis[0]:.6g} to {axis[-1]:.6g}, asked for {places.min():.6g} to "
            f"{places.max():.6g}; allowed: within {low:.6g} to {high:.6g} (are both in metres?)"
        )
