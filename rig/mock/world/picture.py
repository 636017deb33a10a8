"""Surface displacement around a contact: smooth closed forms, plausible but not a solution.

The mock bench needs markers that move with the contact; stress analysis is in `sim`. The shapes
follow the kinematic marker models of the literature (a dilation and a shear term, each decaying
away from the contact), with the decay lengths of a bonded layer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rig.bench.worlds import MarkerView

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


# Common parts of the mock camera's images: a lit gel, noise, and filled marker outlines.

WIDTH, HEIGHT = 640, 480
# Outlines are filled on this many rows and columns per pixel; its shades are counts of them.
FINE = 4
# cv2.fillPoly takes corners in 1/16 of a fine pixel.
_FIXED_BITS = 4
# A filled polygon includes the pixels on its rim, half a fine pixel too much.
_BEYOND = 0.5


class Backdrop:
    """Image of a lit gel without markers, and the noise of the camera.

    Args:
        background: Colour of the gel, RGB.
        grey_noise: Standard deviation of the image noise [grey levels].
        seed: Seed of the noise.
    """

    def __init__(
        self, background: tuple[int, int, int], *, grey_noise: float = 0.0, seed: int = 0
    ) -> None:
        row, column = np.mgrid[0:HEIGHT, 0:WIDTH]
        across = (column - WIDTH / 2) / WIDTH
        down = (row - HEIGHT / 2) / HEIGHT
        vignette = 1.08 - 0.45 * (across**2 + down**2)
        tint = np.stack([1 + 0.18 * across, 1 - 0.10 * down, 1 - 0.18 * across], axis=-1)
        lit = vignette[..., None] * tint * np.array(background)
        self.lit = np.clip(lit, 0, 255).astype(np.uint8)
        """RGB (480, 640, 3)."""
        self._noise = None
        if grey_noise > 0:
            # Random crops of one noise bank cost a copy instead of a million random numbers.
            rng = np.random.default_rng(seed)
            bank = rng.normal(0, grey_noise, (HEIGHT + 64, WIDTH + 64, 3))
            self._noise, self._rng = bank.round().astype(np.int16), rng

    def noisy(self, image: np.ndarray) -> np.ndarray:
        """Return the image (480, 640, 3) with the camera's noise, if it has any."""
        if self._noise is None:
            return image
        top, left = self._rng.integers(0, 64, 2)
        noise = self._noise[top : top + HEIGHT, left : left + WIDTH]
        noisy: np.ndarray = np.clip(image.astype(np.int16) + noise, 0, 255).astype(np.uint8)
        return noisy


class MarkerPicture:
    """Markers of any shape on a lit gel."""

    def __init__(
        self,
        *,
        background: tuple[int, int, int],
        ink: tuple[int, int, int],
        grey_noise: float = 0.0,
        seed: int = 0,
    ) -> None:
        self._backdrop = Backdrop(background, grey_noise=grey_noise, seed=seed)
        self._ink = np.broadcast_to(np.array(ink, np.uint8), (HEIGHT, WIDTH, 3)).copy()

    def image(self, rims: np.ndarray) -> np.ndarray:
        """Return the image, RGB (480, 640, 3) uint8, of markers with these rims (n, m, 2) [px]."""
        import cv2

        fraction = cv2.merge([coverage(rims)] * 3)
        lit = cv2.multiply(self._backdrop.lit, 255 - fraction, scale=1 / 255)
        image: np.ndarray = cv2.add(lit, cv2.multiply(self._ink, fraction, scale=1 / 255))
        return self._backdrop.noisy(image)


def coverage(rims: np.ndarray) -> np.ndarray:
    """Return the fraction of each pixel inside a rim (480, 640) uint8, 255 for a covered pixel.

    Args:
        rims: Column and row of the rims' points (n, m, 2) [px]; whole numbers are pixel centres.
    """
    import cv2

    middle = rims.mean(axis=1, keepdims=True)
    offset = rims - middle
    length = np.maximum(np.linalg.norm(offset, axis=-1, keepdims=True), 1e-9)
    inner = middle + offset * np.maximum(1 - _BEYOND / FINE / length, 0.0)
    # The centre of the fine pixel k lies at (k + 1/2) / FINE - 1/2.
    fine = ((inner + 0.5) * FINE - 0.5) * (1 << _FIXED_BITS)
    canvas = np.zeros((FINE * HEIGHT, FINE * WIDTH), np.uint8)
    for corners in np.rint(fine).astype(np.int32):
        cv2.fillPoly(canvas, [corners], 255, lineType=cv2.LINE_8, shift=_FIXED_BITS)
    fraction: np.ndarray = cv2.resize(canvas, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    return fraction


# View of the mock camera: dark markers on a lit gel, moving with the surface.

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
        import cv2

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
