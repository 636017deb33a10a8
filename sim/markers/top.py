"""Fine, even grid of material points of a gel's top, from which images are rendered."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sim.arrays import Array
from sim.errors import SceneError, check_range
from sim.scene import Body


@dataclass(frozen=True, slots=True)
class Top:
    """Material points of the undeformed top, from border to border."""

    x: Array
    """x of the points (N,) [m], evenly spaced."""
    y: Array
    """y of the points (M,) [m], evenly spaced."""
    height: Array
    """Height of the undeformed top at the points (N, M) [m]; 0 if flat."""

    @property
    def corner(self) -> tuple[float, float]:
        """Position of the first point, x and y [m]."""
        return float(self.x[0]), float(self.y[0])

    @property
    def step(self) -> tuple[float, float]:
        """Distance between neighbours along x and y [m]."""
        return float(self.x[1] - self.x[0]), float(self.y[1] - self.y[0])


def top_of(body: Body, spacing: float) -> Top:
    """Return the grid of a body with points about `spacing` [m] apart.

    Raises:
        SceneError: The spacing is out of range.
    """
    check_range("render", "spacing", spacing, 1e-6, min(body.size_x, body.size_y) / 4, unit="m")
    x, y = (
        np.linspace(-size / 2, size / 2, max(2, round(size / spacing) + 1))
        for size in (body.size_x, body.size_y)
    )
    return Top(x, y, body.heights(x, y))


# Smooth interpolation between unevenly spaced values, with four weights for each place.
#
# The curve consists of cubic Hermite pieces. Its slope at a value is that of the parabola through
# the value and its neighbours (at an end, through the last three). Curve and slope are continuous,
# parabolas are reproduced exactly, and weights do not depend on the values.

# Number of values that each place depends on.
TAPS = 4


@dataclass(frozen=True, slots=True)
class CubicTaps:
    """Interpolation weights of places."""

    first: NDArray[np.int32]
    """Index of the first of four neighbouring values (n,)."""
    weight: NDArray[np.float32]
    """Weights of the four values (n, 4), with a sum of 1."""


def cubic_taps(axis: Array, places: Array, *, name: str = "axis") -> CubicTaps:
    """Return taps for places (n,) among values at `axis` (m,), both in the same unit.

    Beyond the ends the curve is extrapolated linearly, by at most one interval.

    Raises:
        SceneError: There are fewer than four values, the axis does not ascend, or places are
            further outside.
    """
    _check(axis, places, name)
    count = len(axis)
    unit = np.eye(count)
    slope = np.gradient(unit, axis, axis=0, edge_order=2)
    cell = np.clip(np.searchsorted(axis, places, side="right") - 1, 0, count - 2)
    width = axis[cell + 1] - axis[cell]
    fraction = (places - axis[cell]) / width
    inside = np.clip(fraction, 0, 1)
    beyond = (fraction - inside) * width
    start, end = unit[cell], unit[cell + 1]
    start_slope, end_slope = slope[cell], slope[cell + 1]
    t = inside[:, None]
    weight = (1 + 2 * t) * (1 - t) ** 2 * start + t**2 * (3 - 2 * t) * end
    weight += width[:, None] * t * (1 - t) * ((1 - t) * start_slope - t * end_slope)
    weight += beyond[:, None] * np.where(t < 0.5, start_slope, end_slope)
    first = np.clip(cell - 1, 0, count - TAPS)
    weights = np.take_along_axis(weight, first[:, None] + np.arange(TAPS), axis=1)
    return CubicTaps(first.astype(np.int32), weights.astype(np.float32))


def _check(axis: Array, places: Array, name: str) -> None:
    if axis.ndim != 1 or len(axis) < TAPS:
        raise SceneError(f"{name}: shape {axis.shape}; allowed: at least {TAPS} places in a row")
    if not np.isfinite(axis).all() or not all(a < b for a, b in pairwise(axis)):
        raise SceneError(f"{name}: does not rise; allowed: rising, finite places")
    room = axis[1] - axis[0], axis[-1] - axis[-2]
    low, high = axis[0] - room[0], axis[-1] + room[1]
    if places.min() < low or places.max() > high:
        raise SceneError(
            f"{name}: {axis[0]:.6g} to {axis[-1]:.6g}, requested {places.min():.6g} to "
            f"{places.max():.6g}; allowed: within {low:.6g} to {high:.6g} (are both in metres?)"
        )
