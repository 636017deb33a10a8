"""Pictures in colour of a simulated GelSight: a reflecting skin, shaded by lamps by its slope.

They are for figures, and for tests of segmentation. There are no shadows, and the gel spreads no
light.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from sim.markers import Renderer
from sim.sensors import CameraReadout, CameraSignal, SimulatedSensor, SurfaceField
from sim.sensors.field import outward_normals

Array = NDArray[np.float64]
Colour = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Lamp:
    """Distant lamp."""

    azimuth: float
    """Direction that its light comes from, in the image: anticlockwise from the right [rad]."""
    elevation: float
    """Elevation above the plane of the gel, on the camera's side [rad], 0 to pi / 2."""
    colour: Colour
    """Red, green, blue reflected by a skin that faces the lamp, 0 to 255."""

    @property
    def direction(self) -> Array:
        """Unit vector (3,) towards the lamp: right, up, towards the camera."""
        level = math.cos(self.elevation)
        return np.array(
            [
                level * math.cos(self.azimuth),
                level * math.sin(self.azimuth),
                math.sin(self.elevation),
            ]
        )


@dataclass(frozen=True, slots=True)
class Shading:
    """Phong's reflection model (Communications of the ACM 18, 1975) of the skin."""

    lamps: tuple[Lamp, ...]
    """The lamps, 1 to 8."""
    background: Colour
    """Red, green, blue of the skin without lamps, 0 to 255."""
    ambient: float = 0.8
    """Fraction of the background that is always visible."""
    diffuse: float = 0.6
    """Fraction of a lamp's colour that is reflected diffusely."""
    specular: float = 0.3
    """Fraction of a lamp's colour that is reflected specularly."""
    shininess: float = 5.0
    """Exponent of the specular reflection; larger values give smaller highlights."""
    ink: Colour = (28.0, 26.0, 30.0)
    """Red, green, blue of a marker, 0 to 255."""

    def colours(self, normals: Array) -> Array:
        """Return red, green, blue (..., 3), 0 to 255, of skin with outward normals (..., 3).

        The camera looks from inside, at the back of the skin, whose normal is opposite; x stays to
        the right (`sim.markers`).
        """
        facing = normals * np.array([-1.0, -1.0, 1.0])
        light = self.ambient * np.broadcast_to(np.array(self.background), normals.shape)
        for lamp in self.lamps:
            cosine = facing @ lamp.direction
            mirrored = 2 * cosine * facing[..., 2] - lamp.direction[2]
            lit = self.diffuse * np.maximum(cosine, 0.0)
            lit += self.specular * np.where(cosine > 0, np.maximum(mirrored, 0.0), 0.0) ** (
                self.shininess
            )
            light = light + lit[..., None] * np.array(lamp.colour)
        return np.clip(light, 0.0, 255.0)

    def image(
        self, normals: Array, x: Array, y: Array, material: Array, coverage: Array
    ) -> NDArray[np.uint8]:
        """Return a picture (H, W, 3) of the lit skin with markers in ink.

        Args:
            normals: Outward normals of the skin (X, Y, 3) on the even grid `x`, `y`.
            x: Grid along x (X,) [m].
            y: Grid along y (Y,) [m].
            material: Undeformed (x, y) [m] of the material point at each pixel (H, W, 2), or NaN.
            coverage: Fraction of each pixel that markers cover (H, W), 0 to 1.
        """
        seen = np.isfinite(material[..., 0])
        places = np.where(seen[..., None], material, 0.0)
        steps = (places - [x[0], y[0]]) / [x[1] - x[0], y[1] - y[0]]
        at = np.moveaxis(steps, -1, 0)
        normal = np.stack(
            [map_coordinates(normals[..., axis], at, order=1, mode="nearest") for axis in range(3)],
            axis=-1,
        )
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        fraction = np.where(seen, coverage, 0.0)[..., None]
        light = (1 - fraction) * self.colours(normal) + fraction * np.array(self.ink)
        light[~seen] = 0.0
        return np.rint(light).astype(np.uint8)


# Lamps of the GelSight: on the left, below and on the right; assumed.
GELSIGHT = Shading(
    lamps=(
        Lamp(math.radians(180.0), math.radians(25.0), (150.0, 30.0, 30.0)),
        Lamp(math.radians(300.0), math.radians(25.0), (30.0, 150.0, 30.0)),
        Lamp(math.radians(60.0), math.radians(25.0), (30.0, 30.0, 160.0)),
    ),
    background=(90.0, 90.0, 95.0),
)


def pictures(
    sensor: SimulatedSensor, reader: CameraReadout, top: SurfaceField
) -> NDArray[np.uint8]:
    """Return pictures (F, 480, 640, 3) of the skin under `GELSIGHT`, with its first markers."""
    assert isinstance(sensor.signal, CameraSignal)
    renderer = Renderer(sensor.body, reader.camera, device="cpu")
    seen = reader.visible(top)
    view = renderer.see(seen.x, seen.y, seen.displacement)
    material = view.material()
    coverage = view.coverage(renderer.textures(sensor.signal.drawn()))[:, 0] / 255.0
    even = seen.even()
    normals = outward_normals(even)
    return np.stack(
        [
            GELSIGHT.image(normals[frame], even.x, even.y, material[frame], coverage[frame])
            for frame in range(len(top))
        ]
    )
