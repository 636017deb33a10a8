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
from sim.sensors import CameraSignal, SimulatedSensor
from sim.stream.stream import LiveTips

# Points per rim: the chords of a disc lie at most 0.5 % of its radius inside it.
POINTS = 32


class LiveMarkers:
    """Markers of a sensor's first pattern, for displacements given at the points of a grid.

    Raises:
        SceneError: The sensor has no camera.
    """

    def __init__(self, sensor: SimulatedSensor, grid: PixelGrid) -> None:
        x, y = np.asarray(grid.x, np.float64), np.asarray(grid.y, np.float64)
        signal = sensor.signal
        if not isinstance(signal, CameraSignal):
            raise SceneError(f"{sensor.name}.signal: taxels; allowed: a camera")
        self._camera = signal.camera()
        pattern = signal.drawn()[0]
        self._rings = _ring(pattern)
        self._centres = pattern.centres
        self._tips = None
        if signal.pins is not None:
            self._tips = LiveTips(signal.pins, x, y, self._centres)
        points = self._centres if self._tips else self._centres[:, None] + self._rings
        flat = points.reshape(-1, 2)
        self._places = np.column_stack([flat, sensor.body.heights_at(flat[:, 0], flat[:, 1])])
        self._index, self._weight = _taps(x, y, flat)

    def outlines(self, displacement: NDArray[np.float32]) -> Array:
        """Return column and row of the points of every rim (markers, POINTS, 2) [px].

        The displacement of the top is (X, Y, 3) [m].
        """
        if self._tips is not None:
            return self._round(self._tips.displacement(displacement))
        values = displacement.reshape(-1, 3)[self._index]
        moved = np.einsum("nt,ntc->nc", self._weight, values)
        pixels: Array = self._camera.project(self._places + moved)
        return pixels.reshape(len(self._centres), POINTS, 2)

    def _round(self, moved: Array) -> Array:
        """Return rims of tips displaced by (n, 3) [m]: rigid and round, larger when nearer."""
        tips = self._places + moved
        # Without the camera's rotation, which leaves a disc unchanged.
        size = self._camera.focal / (self._camera.distance + tips[:, 2])
        rims = self._rings * size[:, None, None] * np.array([1.0, -1.0])
        return np.asarray(self._camera.project(tips)[:, None] + rims)


def _ring(pattern: Pattern) -> Array:
    """Return a marker's rim about its centre (POINTS, 2) [m]."""
    turn = np.arange(POINTS) * (math.tau / POINTS)
    if pattern.shape == "disc":
        # Same area as the disc: the polygon's area is POINTS / 2 sin(2 pi / POINTS) r^2.
        radius = pattern.size / 2 * math.sqrt(math.tau / POINTS / math.sin(math.tau / POINTS))
        return radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    stands = pattern.shape == "diamond"
    half = pattern.size / 2 / (math.sqrt(2) if stands else 1.0)
    angle = pattern.angle + (math.pi / 4 if stands else 0.0)
    side = np.linspace(-half, half, POINTS // 4, endpoint=False)
    edge = np.full_like(side, half)
    square = np.concatenate(
        [
            np.stack([side, -edge], axis=1),
            np.stack([edge, side], axis=1),
            np.stack([-side, edge], axis=1),
            np.stack([-edge, -side], axis=1),
        ]
    )
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.asarray(square @ np.array([[cosine, sine], [-sine, cosine]]))


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
