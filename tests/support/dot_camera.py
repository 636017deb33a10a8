"""Pictures of dots on a shaded gel, moved by smooth closed forms around a round contact."""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from rig.mock.world.picture import HEIGHT, WIDTH, Backdrop

# Outward motion at the edge of the contact, per depth: between 0.09 mm and 0.18 mm around a sphere
# pressed 1.4 mm over most of the layer in converged runs, more at the edge of a flat punch.
_DILATION = 0.35


@dataclass(frozen=True, slots=True)
class PressedSurface:
    """State of the surface under one round contact, in the contact frame."""

    centre: tuple[float, float]
    """Centre of the contact [m]."""
    depth: float
    """Indentation [m], 0 without contact."""
    radius: float
    """Radius of the contact [m]."""
    thickness: float
    """Thickness of the layer, the decay length of all displacements [m]."""
    shear: tuple[float, float]
    """Tangential displacement of the surface in the contact [m]."""

    def displacement(self, points: np.ndarray) -> np.ndarray:
        """Return the displacement of material points of the surface.

        Args:
            points: Undeformed positions (n, 2) in the contact frame [m].

        Returns:
            Displacement (n, 3) [m]; z is negative under the indenter.
        """
        moved = np.zeros((len(points), 3))
        if self.depth <= 0:
            return moved
        # The material now under the tip was dragged there by the shear.
        home = np.array(self.centre) - np.array(self.shear)
        offset = points - home
        distance = np.hypot(offset[:, 0], offset[:, 1])
        outside = np.maximum(distance - self.radius, 0.0) / self.thickness
        moved[:, :2] = np.array(self.shear) * np.exp(-outside)[:, None]
        # Outward: linear inside the contact, largest at its edge, decaying over the thickness.
        reach = self.radius + 0.25 * self.thickness
        ratio = distance / reach
        dilation = _DILATION * self.depth * np.exp(0.5 * (1 - ratio**2)) / reach
        moved[:, :2] += offset * dilation[:, None]
        moved[:, 2] = -self.depth * np.exp(-2 * outside)
        return moved


@dataclass(frozen=True, slots=True)
class MarkerView:
    """Marker pattern and the camera that views it along -z, x to the right, y up."""

    layout: Literal["grid", "hexagon"]
    """Rows and columns, or rings of a hexagonal packing (rings 6 make 127 pins)."""
    pitch: float
    """Distance between neighbouring markers [m]."""
    radius: float
    """Radius of a marker [m]."""
    pixel: float
    """Pixel size on the surface [m]."""
    rows: int = 7
    """Rows of a grid."""
    columns: int = 9
    """Columns of a grid."""
    rings: int = 6
    """Rings of a hexagon around its middle pin."""
    background: tuple[int, int, int] = (150, 138, 120)
    """Colour of the gel, RGB."""
    ink: tuple[int, int, int] = (28, 26, 30)
    """Colour of the markers, RGB."""

    def points(self) -> np.ndarray:
        """Return the marker positions (n, 2) without contact, in the contact frame [m]."""
        if self.layout == "grid":
            x = (np.arange(self.columns) - (self.columns - 1) / 2) * self.pitch
            y = (np.arange(self.rows) - (self.rows - 1) / 2) * self.pitch
            grid_x, grid_y = np.meshgrid(x, y)
            return np.stack([grid_x.ravel(), grid_y.ravel()], axis=1)
        reach = range(-self.rings, self.rings + 1)
        axial = [(q, r) for q in reach for r in reach if abs(q + r) <= self.rings]
        return np.array([(self.pitch * (q + r / 2), self.pitch * r * 3**0.5 / 2) for q, r in axial])


# cv2.circle takes centres and radii in 1/16 px, so a marker moves smoothly.
_SUBPIXEL_BITS = 4
# Largest change of grey on a dent's flank, and the depth [m] at which half of it is reached.
_SHADE, _SHADE_DEPTH = 90.0, 1.5e-3


class MarkerCamera:
    """Draws a `MarkerView` of a deformed surface."""

    def __init__(self, view: MarkerView, *, grey_noise: float = 0.0, seed: int = 0) -> None:
        self._view = view
        self._points = view.points()
        self._backdrop = Backdrop(view.background, grey_noise=grey_noise, seed=seed)
        self._column = np.arange(WIDTH, dtype=np.float32)[None, :]
        self._row = np.arange(HEIGHT, dtype=np.float32)[:, None]

    def pixels(self, surface: PressedSurface) -> np.ndarray:
        """Return the marker centres (n, 2) as column and row [px]."""
        moved = self._points + surface.displacement(self._points)[:, :2]
        return np.stack(
            [
                WIDTH / 2 - 0.5 + moved[:, 0] / self._view.pixel,
                HEIGHT / 2 - 0.5 - moved[:, 1] / self._view.pixel,
            ],
            axis=1,
        )

    def image(self, surface: PressedSurface) -> np.ndarray:
        """Return the view as RGB (480, 640, 3) uint8."""
        image: np.ndarray = self._backdrop.lit.copy()
        if surface.depth > 0:
            self._shade(image, surface)
        scale = 1 << _SUBPIXEL_BITS
        radius = round(self._view.radius / self._view.pixel * scale)
        for column, row in (self.pixels(surface) * scale).round().astype(int).tolist():
            cv2.circle(
                image,
                (column, row),
                radius,
                self._view.ink,
                thickness=-1,
                lineType=cv2.LINE_AA,
                shift=_SUBPIXEL_BITS,
            )
        return self._backdrop.noisy(image)

    def _shade(self, image: np.ndarray, surface: PressedSurface) -> None:
        """Brighten the side of the dent that faces the lamp, darken the other (in place)."""
        view = self._view
        centre_column = WIDTH / 2 + surface.centre[0] / view.pixel
        centre_row = HEIGHT / 2 - surface.centre[1] / view.pixel
        reach = (surface.radius + 0.4 * surface.thickness) / view.pixel
        left, right = (int(np.clip(centre_column + s * 2.5 * reach, 0, WIDTH)) for s in (-1, 1))
        top, bottom = (int(np.clip(centre_row + s * 2.5 * reach, 0, HEIGHT)) for s in (-1, 1))
        if left >= right or top >= bottom:
            return
        across = (self._column[:, left:right] - np.float32(centre_column)) / np.float32(reach)
        down = (self._row[top:bottom] - np.float32(centre_row)) / np.float32(reach)
        bell = np.exp(-(across**2 + down**2))
        slope = _SHADE * surface.depth / (surface.depth + _SHADE_DEPTH) * bell
        patch = image[top:bottom, left:right].astype(np.float32)
        for channel, (east, south) in enumerate(((1.0, 0.2), (-0.3, -1.0), (-0.7, 0.8))):
            patch[..., channel] += slope * (east * across + south * down)
        image[top:bottom, left:right] = np.clip(patch, 0, 255)
