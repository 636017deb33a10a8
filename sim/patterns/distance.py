"""What rendering sees of any pattern: its signed distance, sampled over the gel."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sim.body import Body
from sim.checks import check_range

Array = NDArray[np.float64]

STEP = 20e-6
"""Between samples [m]: with it the edge of a disc of 0.25 mm radius is 0.2 um off at most."""
BAND = 0.25e-3
"""How far from a marker the distance is told [m]; several pixels of every camera in use."""


class Markers(Protocol):
    """What can be drawn on a gel."""

    @property
    def name(self) -> str:
        """What to call it."""

    def distance(self, x: Array, y: Array, band: float) -> Array:
        """Signed distance (Y, X) [m] at rising x (X,) and y (Y,), negative inside a marker."""

    def check_within(self, size_x: float, size_y: float) -> None:
        """Refuse a gel that the markers do not fit on."""


@dataclass(frozen=True, slots=True, eq=False)
class DistanceTexture:
    """Signed distance to the nearest edge of a marker; bilinear in between, negative inside."""

    name: str
    values: NDArray[np.float32]
    """(Y, X) [m]; x along the second axis, y upwards along the first."""
    corner: tuple[float, float]
    """x and y of the first value [m]."""
    step: float
    """Distance of neighbours [m]."""


def distance_texture(markers: Markers, body: Body, *, step: float = STEP) -> DistanceTexture:
    """The texture of a pattern over the whole top of a gel.

    Raises:
        SceneError: A marker beyond the gel's border, or a step out of range.
    """
    check_range("texture", "step", step, 1e-6, 1e-3, unit="m")
    markers.check_within(body.size_x, body.size_y)
    x, y = (_samples(size, step) for size in (body.size_x, body.size_y))
    values = markers.distance(x, y, max(BAND, 2 * step)).astype(np.float32)
    return DistanceTexture(markers.name, values, (float(x[0]), float(y[0])), step)


def _samples(size: float, step: float) -> Array:
    """Places about 0 that cover `size`."""
    count = math.ceil(size / step - 1e-9) + 1
    return np.asarray((np.arange(count) - (count - 1) / 2) * step)
