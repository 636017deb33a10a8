"""Pinhole camera on the gel's axis, and its projection of points of the gel."""

import math
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

from sim.arrays import Array
from sim.errors import check_range
from sim.scene import Body

# Size of an image [px], as that of a mask in `recorder.markers`, whose import needs a store.
WIDTH, HEIGHT = 640, 480
# Focal length and width of the film [m]: Blender's defaults, used for the paper's images.
LENS, FILM = 35e-3, 36e-3
# The same focal length in pixels.
FOCAL = LENS / FILM * WIDTH
# Distance from the paper's pinhole to the undeformed top [m], at which a pixel covers 33.9 um.
DISTANCE = 21.11e-3
# Column and row of the middle of the image; pixel centres are at integers.
MIDDLE = ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)
# Greatest tilt of a camera [rad].
TILT_MOST = 0.5


@dataclass(frozen=True, slots=True)
class Camera:
    """Pinhole camera that looks up at the gel's top from below, along z of the contact frame.

    Level and without shift and rotation: column = 319.5 + focal x / (distance + z), row = 239.5 -
    focal y / (distance + z). So x is to the right and y up, as seen from the touched side; a real
    camera below sees the mirror image.

    Raises:
        SceneError: A value is out of range.
    """

    focal: float = FOCAL
    """Focal length [px], 1 to 1e6."""
    distance: float = DISTANCE
    """Distance from the pinhole to the undeformed top (a dome's apex) [m], 1e-4 to 10."""
    shift: tuple[float, float] = (0.0, 0.0)
    """Shift of the image by the mount, to the right and downwards [px], up to 1000."""
    rotation: float = 0.0
    """Rotation of the image by the mount before the shift, anticlockwise about the middle [rad]."""
    tilt: tuple[float, float] = field(default=(0.0, 0.0), metadata={"stored": "unless default"})
    """Tilt about the pinhole, a rotation vector about x and y [rad], up to 0.5. The gel's axis
    stays in the middle: motion of the image as a whole is in the shift."""

    def __post_init__(self) -> None:
        check_range("camera", "focal", self.focal, 1.0, 1e6, unit="px")
        check_range("camera", "distance", self.distance, 1e-4, 10.0, unit="m")
        for index, value in enumerate(self.shift):
            check_range("camera", f"shift[{index}]", value, -1000.0, 1000.0, unit="px")
        check_range("camera", "rotation", self.rotation, -math.pi, math.pi, unit="rad")
        for index, value in enumerate(self.tilt):
            check_range("camera", f"tilt[{index}]", value, -TILT_MOST, TILT_MOST, unit="rad")

    @classmethod
    def paper(cls) -> Self:
        """Return the camera of the paper's simulated images."""
        return cls()

    @classmethod
    def of_scale(cls, mm_per_px: float) -> Self:
        """Return the paper's lens at the distance with this pixel size on the undeformed top."""
        check_range("camera", "mm_per_px", mm_per_px, 1e-4, 10.0, unit="mm")
        return cls(distance=mm_per_px * 1e-3 * FOCAL)

    @property
    def mm_per_px(self) -> float:
        """Size of a pixel on the undeformed top [mm]."""
        return 1e3 * self.distance / self.focal

    def on_film(self, points: Array) -> Array:
        """Return image positions (..., 2) [px] of points (..., 3) [m] from the axis, x right, y up.

        Without tilt, these are focal (x, y) / (distance + z), larger for pressed points, which are
        nearer. They do not include the mount's shift and rotation.
        """
        if not any(self.tilt):
            return np.asarray(self.focal * points[..., :2] / (self.distance + points[..., 2:]))
        turned = self._turned(points)
        return np.asarray(self.focal * (turned[..., :2] / turned[..., 2:] - self.middle))

    def depths(self, points: Array) -> Array:
        """Return the depth (...) [m] of points (..., 3) in front of the pinhole, along its axis."""
        if not any(self.tilt):
            return np.asarray(self.distance + points[..., 2])
        return np.asarray(self._turned(points)[..., 2])

    @property
    def turn(self) -> Array:
        """Matrix (3, 3) from places about the pinhole to those along the camera's own axes."""
        return np.asarray(Rotation.from_rotvec([*self.tilt, 0.0]).inv().as_matrix())

    @property
    def middle(self) -> Array:
        """Place (2,) of the gel's axis in the plane at depth 1, along the camera's own axes."""
        x, y, z = self.turn[:, 2]
        return np.array([x / z, y / z])

    def _turned(self, points: Array) -> Array:
        return np.asarray((points + np.array([0.0, 0.0, self.distance])) @ self.turn.T)

    def project(self, points: Array) -> Array:
        """Return column and row (..., 2) [px] of points (..., 3) in the contact frame."""
        x, y = np.moveaxis(self.on_film(points), -1, 0)
        cosine, sine = math.cos(self.rotation), math.sin(self.rotation)
        return np.stack(
            [
                MIDDLE[0] + cosine * x - sine * y + self.shift[0],
                MIDDLE[1] - sine * x - cosine * y + self.shift[1],
            ],
            axis=-1,
        )

    def places(self, pixels: Array, body: Body) -> Array:
        """Return x and y (..., 2) [m] on the body's undeformed top at pixels (..., 2).

        The top is extended beyond the body; NaN where the ray misses the sphere of a dome.
        """
        right = pixels[..., 0] - MIDDLE[0] - self.shift[0]
        up = MIDDLE[1] + self.shift[1] - pixels[..., 1]
        cosine, sine = math.cos(self.rotation), math.sin(self.rotation)
        slope = np.stack([cosine * right + sine * up, cosine * up - sine * right], axis=-1)
        slope = slope / self.focal
        if any(self.tilt):
            ahead = np.concatenate([slope + self.middle, np.ones((*slope.shape[:-1], 1))], axis=-1)
            ray = ahead @ self.turn
            slope = ray[..., :2] / ray[..., 2:]
        if body.dome_radius is None:
            return np.asarray(slope * self.distance)
        # A point of the ray is (slope d, d - distance); the sphere's centre is at -dome_radius.
        low = body.dome_radius - self.distance
        size = 1 + (slope**2).sum(axis=-1)
        root = low**2 - size * (low**2 - body.dome_radius**2)
        depth = np.where(root >= 0, np.sqrt(np.maximum(root, 0)) - low, np.nan) / size
        return np.asarray(slope * depth[..., None])
