"""Where a camera below the gel sees markers that stick to its top: the paper's pinhole."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.body import Body

Array = NDArray[np.float64]

LENS, FILM = 35e-3, 36e-3
"""Focal length and width of the film [m]: Blender's defaults, which the paper renders with."""
WIDTH = 640
"""Pixels along the film."""
DISTANCE = 21.11e-3
"""From the pinhole to the untouched top [m]; the camera looks up at it from below."""
FOCAL = LENS / FILM * WIDTH
"""Focal length in pixels: a pixel sees DISTANCE / FOCAL = 33.9 um of the untouched top."""
MARKERS = 14
"""Markers along each side of the body."""


def marker_places(body: Body) -> tuple[Array, Array]:
    """Places x (14,) and y (14,) of the regular grid of markers on the untouched top [m]."""
    share = (np.arange(MARKERS) + 0.5) / MARKERS - 0.5
    return share * body.size_x, share * body.size_y


def seen(place: Array) -> Array:
    """Pixels (..., 2), from the middle of the image, of points (..., 3) in the contact frame [m].

    p = FOCAL (x, y) / (DISTANCE + z): what is pressed comes nearer and looks larger.
    """
    return FOCAL * place[..., :2] / (DISTANCE + place[..., 2:])
