"""Readings of a sensor of a World: pictures of its markers, or raw counts of its taxels."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rig.bench.worlds import Noise, WorldSpec
from rig.mock.world.lab import Exposure
from rig.mock.world.picture import MarkerPicture
from rig.mock.world.sensors import markers_of, pad_of, taxels_of


class Reading(NamedTuple):
    """Points of a skin (n, 2) [m], and a function of their displacement (n, 3) [m] and a time [ns].

    It returns RGB (480, 640, 3) uint8, or raw counts (taxels, 3) before noise.
    """

    points: np.ndarray
    read: Callable[[np.ndarray, int], np.ndarray]


def reading_of(spec: WorldSpec, kind: str = "") -> Reading:
    """Return the reading of a World's sensor, of `kind` camera or taxels; empty: as the row has.

    Raises:
        ConfigError: The sensor is unknown or of the other kind, or the simulator is not installed.
    """
    if (kind or ("taxels" if taxels_of(spec)[0] else "camera")) == "taxels":
        points, counts = pad_of(spec)
        return Reading(points, lambda moved, _: counts(moved))
    markers, exposure, grey = markers_of(spec), Exposure(spec.lab), (spec.noise or Noise()).grey
    picture = MarkerPicture(
        background=spec.background, ink=spec.ink, light=spec.light, grey_noise=grey
    )
    return Reading(
        markers.points,
        lambda moved, t_ns: exposure.passed(picture.image(markers.outlines(moved)), t_ns),
    )
