"""Where a camera below the gel sees markers that stick to its top: the paper's pinhole."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.body import Body
from sim.camera import DISTANCE, FOCAL, Camera

__all__ = ["DISTANCE", "FOCAL", "MARKERS", "marker_places", "seen"]

Array = NDArray[np.float64]

MARKERS = 14
"""Markers along each side of the body."""


def marker_places(body: Body) -> tuple[Array, Array]:
    """Places x (14,) and y (14,) of the regular grid of markers on the untouched top [m]."""
    share = (np.arange(MARKERS) + 0.5) / MARKERS - 0.5
    return share * body.size_x, share * body.size_y


def seen(place: Array) -> Array:
    """Pixels (..., 2), from the middle of the image, of points (..., 3) in the contact frame [m].

    The paper's camera; x to the right and y up.
    """
    return Camera.paper().on_film(place)
