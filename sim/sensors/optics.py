"""Colours of a GelSight: a reflecting skin, shaded by lamps according to its slope; and pins."""

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
    """Distant lamp."""

    azimuth: float = field(metadata={"unit": "deg"})
    """Direction that its light comes from, in the image: anticlockwise from the right [rad]."""
    elevation: float = field(metadata={"unit": "deg"})
    """Elevation above the plane of the gel, on the camera's side [rad], 0 to pi / 2."""
    colour: Colour
    """Red, green, blue reflected by a skin that faces the lamp, 0 to 255."""

    def __post_init__(self) -> None:
        check_range("lamp", "elevation", self.elevation, 0.0, math.pi / 2, unit="rad")
        _check_colour("lamp", self.colour)

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
    """Phong's reflection model (Communications of the ACM 18, 1975) of the skin.

    Raises:
        SceneError: A value is out of range.
    """

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

    def __post_init__(self) -> None:
        if not 1 <= len(self.lamps) <= 8:
            raise SceneError(f"shading.lamps: {len(self.lamps)}; allowed: 1 to 8")
        for name in ("ambient", "diffuse", "specular"):
            check_range("shading", name, getattr(self, name), 0.0, 10.0)
        check_range("shading", "shininess", self.shininess, 1.0, 1000.0)
        _check_colour("shading.background", self.background)
        _check_colour("shading.ink", self.ink)

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
        picture: NDArray[np.uint8] = np.rint(light).astype(np.uint8)
        return picture


def skin_normals(skin: SurfaceField) -> tuple[Array, Array, Array]:
    """Return outward normals (F, X, Y, 3) of a displaced top, and their even grid x, y."""
    even = skin.even()
    return outward_normals(even), even.x, even.y


def _check_colour(owner: str, colour: Colour) -> None:
    if len(colour) != 3:
        raise SceneError(f"{owner}: {colour!r}; allowed: red, green and blue")
    for value in colour:
        check_range(owner, "colour", value, 0.0, 255.0)


# Pins under a skin, as in TacTip and TacPalm: the camera sees their tips, not the skin.


@dataclass(frozen=True, slots=True)
class Pins:
    """Rigid pins on the inner side of the skin that point to the camera.

    Raises:
        SceneError: A length is out of range.
    """

    length: float = field(metadata={"unit": "mm"})
    """Length from the skin to the tip [m], 0 to 0.02; with 0 the tips are the skin."""
    base: float = field(metadata={"unit": "mm"})
    """Width of a pin at the skin [m], 0 to 0.02. A pin moves with the mean of the skin over this
    width, since it does not bend with features narrower than itself."""

    def __post_init__(self) -> None:
        for name in ("length", "base"):
            check_range("pins", name, getattr(self, name), 0.0, 0.02, unit="m")

    def tips(self, skin: SurfaceField) -> SurfaceField:
        """Return the displacement of tips below each point of the skin, on an even grid.

        A tip is at x_tip = x_skin - l n, n the outward normal. It is displaced by

            u_tip = u + l (z - n):  in the plane u_t + l grad(u_z) while the slope is small,

        so the slope of the skin appears multiplied by l: the tips under a dent fan out.
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
        """Return values (F, X, Y, 3) averaged over the base of a pin.

        The weights are a Gaussian with a disc's standard deviation, a quarter of its width.
        """
        for axis, places in ((1, field.x), (2, field.y)):
            spread = self.base / 4 / (places[1] - places[0])
            # Below a tenth of a step the kernel is one sample wide and has no effect.
            if spread > 0.1:
                values = gaussian_filter1d(values, spread, axis=axis, mode="nearest")
        return values


def tip_coverage(centres: Array, radii: Array, *, width: int, height: int) -> NDArray[np.uint8]:
    """Return grey images (F, height, width) of round pin tips, 255 for a fully covered pixel.

    A tip is rigid: it stays round when the skin stretches, and looks larger when nearer.

    Args:
        centres: Columns and rows of the tips (F, n, 2) [px]; whole numbers are pixel centres.
        radii: Their radii (F, n) [px].
        width: Number of columns.
        height: Number of rows.
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
        fraction = np.clip(sizes[:, None, None] - distance + 0.5, 0.0, 1.0)
        rows = np.broadcast_to(row[:, :, None], fraction.shape)
        columns = np.broadcast_to(column[:, None, :], fraction.shape)
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        grey = np.rint(255 * fraction[inside]).astype(np.uint8)
        np.maximum.at(image, (rows[inside], columns[inside]), grey)
    return images
