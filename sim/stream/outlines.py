"""Fast projection of marker rims into the image: each rim is a ring of material points.

Filling the polygons gives an image. `sim.markers` traces every pixel instead, which is correct for
any pattern and for skins that fold over, but takes ten times as long.
"""

import math

import numpy as np
from numpy.typing import NDArray

from sim.arrays import Array
from sim.errors import SceneError
from sim.layer.spectral import PixelGrid
from sim.markers import Pattern
from sim.markers.top import cubic_taps
from sim.sensors import CameraSignal, Pins, SimulatedSensor

# Points per rim: the chords of a disc lie at most 0.5 % of its radius inside it.
POINTS = 32
# Places under a pin at which the skin is read (9, 2), in standard deviations, and their weights:
# three-point Gauss-Hermite quadrature along each axis, exact up to the fifth degree.
NODES = np.sqrt(3.0) * np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
LEAST_SPREAD = 20e-6  # of a pin without a base [m]
SHARES = np.outer([1.0, 4.0, 1.0], [1.0, 4.0, 1.0]).ravel() / 36.0


class LiveMarkers:
    """Markers of a sensor's first pattern.

    Raises:
        SceneError: The sensor has no camera.
    """

    def __init__(self, sensor: SimulatedSensor) -> None:
        signal = sensor.signal
        if not isinstance(signal, CameraSignal):
            raise SceneError(f"{sensor.name}.signal: taxels; allowed: a camera")
        self._camera = signal.camera()
        pattern = signal.drawn()[0]
        self._rings = _ring(pattern)
        self._pins = signal.pins
        about = self._rings if signal.pins is None else _spread(signal.pins) * NODES
        self.points: Array = (pattern.centres[:, None] + about).reshape(-1, 2)
        """Points of the top whose displacement determines the outlines (n, 2) [m]."""
        at = pattern.centres if signal.pins is not None else self.points
        self._places = np.column_stack([at, sensor.body.heights_at(*at.T)])

    def outlines(self, moved: Array) -> Array:
        """Return column and row of rims (markers, POINTS, 2) [px]; `points` moved by (n, 3) [m]."""
        if self._pins is not None:
            return self._round(tips_of(self._pins, np.asarray(moved, float)))
        pixels: Array = self._camera.project(self._places + moved)
        return pixels.reshape(-1, POINTS, 2)

    def _round(self, moved: Array) -> Array:
        """Return rims of tips displaced by (n, 3) [m]: rigid and round, larger when nearer."""
        tips = self._places + moved
        # Without the camera's rotation, which leaves a disc unchanged.
        size = self._camera.focal / (self._camera.distance + tips[:, 2])
        rims = self._rings * size[:, None, None] * np.array([1.0, -1.0])
        return np.asarray(self._camera.project(tips)[:, None] + rims)


def tips_of(pins: Pins, moved: Array) -> Array:
    """Return the displacement of pin tips (n, 3) [m], as `Pins.tips` on a fine grid.

    `moved` (9 n, 3) [m] is that of the skin at `NODES` about each pin, in standard deviations.
    Under a Gaussian weight of standard deviation s the mean slope of u is the mean of u x / s^2
    (Stein's identity), here by three-point Gauss-Hermite quadrature along each axis.
    """
    values = moved.reshape(-1, len(NODES), 3)
    slopes = np.einsum("npc,pk->nkc", values, SHARES[:, None] * NODES) / _spread(pins)
    normal = np.cross(slopes[:, 0] + [1.0, 0.0, 0.0], slopes[:, 1] + [0.0, 1.0, 0.0])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    tips: Array = SHARES @ values + pins.length * (np.array([0.0, 0.0, 1.0]) - normal)
    return tips


def _spread(pins: Pins) -> float:
    """Return the standard deviation of a pin's base along an axis [m], that of a disc."""
    return max(pins.base / 4, LEAST_SPREAD)


class Sampler:
    """Values of a grid at some points (n, 2) [m], by cubic interpolation."""

    def __init__(self, grid: PixelGrid, points: Array) -> None:
        x, y = (np.asarray(axis, np.float64) for axis in (grid.x, grid.y))
        self._index, self._weight = _taps(x, y, points)

    def __call__(self, values: NDArray[np.float32]) -> Array:
        """Return values (X, Y, 3) at the points (n, 3)."""
        return np.asarray(np.einsum("nt,ntc->nc", self._weight, values.reshape(-1, 3)[self._index]))


def _ring(pattern: Pattern) -> Array:
    """Return a marker's rim about its centre (POINTS, 2) [m]."""
    turn = np.arange(POINTS) * (math.tau / POINTS)
    if pattern.shape == "disc":
        # Same area as the disc: the polygon's area is POINTS / 2 sin(2 pi / POINTS) r^2.
        radius = pattern.size / 2 * math.sqrt(math.tau / POINTS / math.sin(math.tau / POINTS))
        return radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    half, angle = pattern.square
    side = np.linspace(-half, half, POINTS // 4, endpoint=False)
    sides = [np.stack([side, np.full_like(side, -half)], axis=1)]
    for _ in range(3):  # each a quarter of a turn on from the one before
        sides.append(sides[-1][:, ::-1] * [-1.0, 1.0])
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.asarray(np.concatenate(sides) @ np.array([[cosine, sine], [-sine, cosine]]))


def _taps(x: Array, y: Array, places: Array) -> tuple[NDArray[np.int64], Array]:
    """Return indices of the X * Y points that places depend on, and weights, both (n, 16)."""
    along_x = cubic_taps(x, places[:, 0], name="surface_x")
    along_y = cubic_taps(y, places[:, 1], name="surface_y")
    step = np.arange(along_x.weight.shape[1])
    row = along_x.first[:, None, None].astype(np.int64) + step[:, None]
    column = along_y.first[:, None, None] + step
    index = (row * len(y) + column).reshape(len(places), -1)
    weight = along_x.weight[:, :, None] * along_y.weight[:, None, :]
    return index, weight.reshape(len(places), -1).astype(np.float64)
