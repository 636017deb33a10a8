"""The colours of a GelSight: three lamps on a reflecting skin that leans."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, map_coordinates

from sim.errors import SceneError, check_range
from sim.sensors.field import SurfaceField, outward_normals

Array = NDArray[np.float64]
Colour = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Lamp:
    """A lamp far away."""

    azimuth: float = field(metadata={"unit": "deg"})
    """Where its light comes from, in the image: 0 is the right, anticlockwise [rad]."""
    elevation: float = field(metadata={"unit": "deg"})
    """How far it stands above the plane of the gel, on the camera's side [rad], 0 to pi / 2."""
    colour: Colour
    """Red, green, blue of what a skin reflects that faces it, 0 to 255."""

    def __post_init__(self) -> None:
        check_range("lamp", "elevation", self.elevation, 0.0, math.pi / 2, unit="rad")
        _check_colour("lamp", self.colour)

    @property
    def direction(self) -> Array:
        """Unit vector (3,) towards the lamp: right, up, to the camera."""
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
    """Phong's model (Communications of the ACM 18, 1975) of the skin as the camera sees it.

    Raises:
        SceneError: A value outside of what is allowed.
    """

    lamps: tuple[Lamp, ...]
    """The lamps, 1 to 8."""
    background: Colour
    """Red, green, blue of the skin without lamps, 0 to 255."""
    ambient: float = 0.8
    """Share of the background that is always seen."""
    diffuse: float = 0.6
    """Share of a lamp's colour that is scattered."""
    specular: float = 0.3
    """Share of it that is mirrored."""
    shininess: float = 5.0
    """Exponent of the mirrored light: the larger, the smaller its spot."""
    ink: Colour = (28.0, 26.0, 30.0)
    """Red, green, blue of a marker, 0 to 255."""

    def __post_init__(self) -> None:
        if not 1 <= len(self.lamps) <= 8:
            raise SceneError(f"shading.lamps: {len(self.lamps)}; allowed: 1 to 8")
        for name in ("ambient", "diffuse", "specular"):
            check_range("shading", name, getattr(self, name), 0.0, 10.0)
        check_range("shading", "shininess", self.shininess, 1.0, 1000.0)
        _check_colour("shading.background", self.background)
        _check_colour("shading.ink", self.ink)

    def colours(self, normals: Array) -> Array:
        """Red, green, blue (..., 3), 0 to 255, of skin with outward unit normals (..., 3).

        The camera looks from inside: it sees the back of the skin, whose normal is the opposite
        one, and x stays to the right (`sim.markers`).
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
        """A picture (H, W, 3): the lit skin, and markers in ink over it.

        Args:
            normals: Of the skin out of the material (X, Y, 3), on the even grid `x`, `y` [m].
            x: (X,) [m].
            y: (Y,) [m].
            material: Untouched (x, y) [m] of what each pixel sees (H, W, 2); NaN sees nothing.
            coverage: How much of each pixel markers cover (H, W), 0 to 1.
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
        share = np.where(seen, coverage, 0.0)[..., None]
        light = (1 - share) * self.colours(normal) + share * np.array(self.ink)
        light[~seen] = 0.0
        picture: NDArray[np.uint8] = np.rint(light).astype(np.uint8)
        return picture


def skin_normals(skin: SurfaceField) -> tuple[Array, Array, Array]:
    """Outward normals (F, X, Y, 3) of a displaced top, and the even grid x, y they are on."""
    even = skin.even()
    return outward_normals(even), even.x, even.y


def _check_colour(owner: str, colour: Colour) -> None:
    if len(colour) != 3:
        raise SceneError(f"{owner}: {colour!r}; allowed: red, green and blue")
    for value in colour:
        check_range(owner, "colour", value, 0.0, 255.0)


# Pins under a skin, as TacTip and TacPalm have them: the camera sees their tips, not the skin.


@dataclass(frozen=True, slots=True)
class Pins:
    """Rigid pins that stand on the inner side of the skin and point to the camera.

    Raises:
        SceneError: A length outside of what is allowed.
    """

    length: float = field(metadata={"unit": "mm"})
    """From the skin to the tip [m], 0 to 0.02; with 0 the tips are the skin."""
    base: float = field(metadata={"unit": "mm"})
    """Width of a pin where it grows out of the skin [m], 0 to 0.02: it moves as the skin under it
    does on average, since a pin does not bend with an edge that is narrower than itself."""

    def __post_init__(self) -> None:
        for name in ("length", "base"):
            check_range("pins", name, getattr(self, name), 0.0, 0.02, unit="m")

    def tips(self, skin: SurfaceField) -> SurfaceField:
        """How tips displace that hang below each point of the skin; an even grid.

        A tip hangs at x_tip = x_skin - l n, n the outward normal. It is displaced by

            u_tip = u + l (z - n):  in the plane u_t + l grad(u_z) while the slope is small,

        so the slope of the skin is seen l times enlarged: the tips under a dent fan out.
        """
        even = skin.even()
        if self.length == 0 and self.base == 0:
            return even
        normal = self._averaged(outward_normals(even), even)
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        normal = normal / np.where(length > 0, length, 1.0)
        moved = self._averaged(even.displacement.astype(float), even)
        moved += self.length * (np.array([0.0, 0.0, 1.0]) - normal)
        return SurfaceField(even.x, even.y, moved.astype(np.float32))

    def _averaged(self, values: Array, field: SurfaceField) -> Array:
        """Values (F, X, Y, 3) averaged over the foot of a pin.

        By a Gaussian with the spread of a disc: along each axis a disc's is a quarter of its width.
        """
        for axis, places in ((1, field.x), (2, field.y)):
            spread = self.base / 4 / (places[1] - places[0])
            # Below a tenth of a step the kernel is one sample wide: nothing to average.
            if spread > 0.1:
                values = gaussian_filter1d(values, spread, axis=axis, mode="nearest")
        return values


def tip_coverage(centres: Array, radii: Array, *, width: int, height: int) -> NDArray[np.uint8]:
    """Grey images (F, height, width) of round pin tips, 255 where a pixel is covered wholly.

    A tip is rigid: it stays round however the skin stretches, and a nearer one looks larger.

    Args:
        centres: Columns and rows of the tips (F, n, 2) [px]; whole numbers are pixel centres.
        radii: Their radii (F, n) [px].
        width: Pixels a row.
        height: Rows.
    """
    reach = math.ceil(float(radii.max(initial=0.0)) + 1.0)
    step = np.arange(-reach, reach + 1)
    images = np.zeros((len(centres), height, width), np.uint8)
    for image, places, sizes in zip(images, centres, radii, strict=True):
        near = np.rint(places).astype(np.int64)
        seen = ((near >= -reach) & (near < np.array([width, height]) + reach)).all(axis=1)
        near, places, sizes = near[seen], places[seen], sizes[seen]
        column = near[:, 0, None] + step
        row = near[:, 1, None] + step
        distance = np.hypot(
            (row - places[:, 1, None])[:, :, None], (column - places[:, 0, None])[:, None, :]
        )
        # Coverage of a pixel by a straight edge at this distance from its centre, to first order.
        share = np.clip(sizes[:, None, None] - distance + 0.5, 0.0, 1.0)
        rows = np.broadcast_to(row[:, :, None], share.shape)
        columns = np.broadcast_to(column[:, None, :], share.shape)
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        grey = np.rint(255 * share[inside]).astype(np.uint8)
        np.maximum.at(image, (rows[inside], columns[inside]), grey)
    return images
