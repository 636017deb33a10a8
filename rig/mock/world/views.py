"""Readings of a sensor of a World: pictures of its markers, or raw counts of its taxels."""

from collections.abc import Callable

import numpy as np

from rig.bench.worlds import Noise, WorldSpec
from rig.mock.world.lab import Exposure
from rig.mock.world.picture import MarkerPicture
from rig.mock.world.sensors import markers_of, pad_of, taxels_of


class Reading:
    """Function of the displacement (n, 3) [m] of a skin's points (n, 2) [m] at a time [ns]."""

    def __init__(self, points: np.ndarray, read: Callable[[np.ndarray, int], np.ndarray]) -> None:
        self.points = points
        """Points of the undeformed skin (n, 2) [m]."""
        self._read = read

    def __call__(self, moved: np.ndarray, t_ns: int) -> np.ndarray:
        """Return RGB (480, 640, 3) uint8, or raw counts (taxels, 3) before noise."""
        return self._read(moved, t_ns)


def reading_of(spec: WorldSpec, kind: str = "") -> Reading:
    """Return the reading of a World's sensor, of `kind` camera or taxels; empty: what it has.

    Raises:
        ConfigError: The sensor is unknown or of the other kind, or the simulator is not installed.
    """
    if (kind or ("taxels" if taxels_of(spec)[0] else "camera")) == "taxels":
        points, counts = pad_of(spec)
        return Reading(points, lambda moved, _: counts(moved))
    markers, exposure = markers_of(spec), Exposure(spec.lab)
    picture = MarkerPicture(
        background=spec.background,
        ink=spec.ink,
        light=spec.light,
        grey_noise=(spec.noise or Noise()).grey,
    )
    return Reading(
        markers.points,
        lambda moved, t_ns: exposure.passed(picture.image(markers.outlines(moved)), t_ns),
    )
