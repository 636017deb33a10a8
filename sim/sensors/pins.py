"""Pins under a skin, as in TacTip and TacPalm: the camera sees their tips, not the skin."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from sim.arrays import Array
from sim.errors import check_range
from sim.sensors.field import SurfaceField, outward_normals


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
        for axis, positions in ((1, field.x), (2, field.y)):
            spread = self.base / 4 / (positions[1] - positions[0])
            # Below a tenth of a step the kernel is one sample wide and has no effect.
            if spread > 0.1:
                values = gaussian_filter1d(values, spread, axis=axis, mode="nearest")
        return values


def tip_coverage(centres: Array, radii: Array, *, width: int, height: int) -> NDArray[np.uint8]:
    """Return grey images (F, height, width) of round pin tips, 255 for a fully covered pixel.

    A tip is rigid: it stays round when the skin stretches, and looks larger when nearer. Centres
    are columns and rows (F, n, 2) [px], whole numbers at pixel centres; radii are (F, n) [px].
    """
    reach = math.ceil(float(radii.max(initial=0.0)) + 1.0)
    step = np.arange(-reach, reach + 1)
    images = np.zeros((len(centres), height, width), np.uint8)
    for image, tips, sizes in zip(images, centres, radii, strict=True):
        near = np.rint(tips).astype(np.int64)
        in_image = ((near >= -reach) & (near < np.array([width, height]) + reach)).all(axis=1)
        near, tips, sizes = near[in_image], tips[in_image], sizes[in_image]
        column = near[:, 0, None] + step
        row = near[:, 1, None] + step
        distance = np.hypot(
            (row - tips[:, 1, None])[:, :, None], (column - tips[:, 0, None])[:, None, :]
        )
        # Coverage of a pixel by a straight edge at this distance from its centre, to first order.
        fraction = np.clip(sizes[:, None, None] - distance + 0.5, 0.0, 1.0)
        rows = np.broadcast_to(row[:, :, None], fraction.shape)
        columns = np.broadcast_to(column[:, None, :], fraction.shape)
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        grey = np.rint(255 * fraction[inside]).astype(np.uint8)
        np.maximum.at(image, (rows[inside], columns[inside]), grey)
    return images
