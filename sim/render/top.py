"""The fine, even grid of material points of a gel's top that images are drawn from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.body import Body
from sim.checks import check_range

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
