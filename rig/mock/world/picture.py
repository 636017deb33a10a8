"""Pictures of the mock camera: a lit gel, noise, and filled marker outlines."""

from typing import Literal

import numpy as np

WIDTH, HEIGHT = 640, 480
# Outlines are filled on this many rows and columns per pixel; its shades are counts of them.
FINE = 4
# cv2.fillPoly takes corners in 1/16 of a fine pixel.
_FIXED_BITS = 4
# A filled polygon includes the pixels on its rim, half a fine pixel too much.
_BEYOND = 0.5


class MarkerPicture:
    """Markers of any shape on a lit gel of an RGB colour, and the noise of the camera.

    The lamps at the sides are coloured, or there is one white light; noise is in grey levels.
    """

    def __init__(
        self,
        *,
        background: tuple[int, int, int],
        ink: tuple[int, int, int],
        light: Literal["coloured", "white"] = "coloured",
        grey_noise: float = 0.0,
        seed: int = 0,
    ) -> None:
        row, column = np.mgrid[0:HEIGHT, 0:WIDTH]
        across = (column - WIDTH / 2) / WIDTH
        down = (row - HEIGHT / 2) / HEIGHT
        vignette = 1.08 - 0.45 * (across**2 + down**2)
        colour = 1.0 if light == "coloured" else 0.0
        sides = (0.18 * across, -0.10 * down, -0.18 * across)
        tint = 1 + colour * np.stack(sides, axis=-1)
        lit = vignette[..., None] * tint * np.array(background)
        self._lit = np.clip(lit, 0, 255).astype(np.uint8)
        self._ink = np.broadcast_to(np.array(ink, np.uint8), (HEIGHT, WIDTH, 3)).copy()
        self._noise = None
        if grey_noise > 0:
            # Random crops of one noise bank cost a copy instead of a million random numbers.
            self._rng = np.random.default_rng(seed)
            bank = self._rng.normal(0, grey_noise, (HEIGHT + 64, WIDTH + 64, 3)).round()
            # Brighter and darker pixels, in the type of the image.
            self._noise = [np.clip(sign * bank, 0, 255).astype(np.uint8) for sign in (1, -1)]
        self._canvas = np.zeros((FINE * HEIGHT, FINE * WIDTH), np.uint8)
        # The last picture without noise, and its rims: nothing moves between two presses.
        self._rims, self._clean = np.zeros(0), self._lit

    def image(self, rims: np.ndarray) -> np.ndarray:
        """Return the image, RGB (480, 640, 3) uint8, of markers with these rims (n, m, 2) [px]."""
        import cv2

        if not np.array_equal(rims, self._rims):
            fraction = cv2.merge([coverage(rims, self._canvas)] * 3)
            lit = cv2.multiply(self._lit, 255 - fraction, scale=1 / 255)
            self._clean = cv2.add(lit, cv2.multiply(self._ink, fraction, scale=1 / 255))
            self._rims = rims
        picture: np.ndarray = self._clean
        if self._noise is None:
            return picture
        top, left = self._rng.integers(0, 64, 2)
        more, less = (bank[top : top + HEIGHT, left : left + WIDTH] for bank in self._noise)
        picture = cv2.subtract(cv2.add(picture, more), less)
        return picture


def coverage(rims: np.ndarray, canvas: np.ndarray | None = None) -> np.ndarray:
    """Return the fraction of each pixel inside a rim (480, 640) uint8, 255 for a covered pixel.

    Rims (n, m, 2) have column and row [px]; whole numbers are pixel centres. The canvas to draw on
    is (480, 640) times `FINE`, uint8.
    """
    import cv2

    middle = rims.mean(axis=1, keepdims=True)
    offset = rims - middle
    length = np.maximum(np.linalg.norm(offset, axis=-1, keepdims=True), 1e-9)
    inner = middle + offset * np.maximum(1 - _BEYOND / FINE / length, 0.0)
    # The centre of the fine pixel k lies at (k + 1/2) / FINE - 1/2.
    fine = ((inner + 0.5) * FINE - 0.5) * (1 << _FIXED_BITS)
    if canvas is None:
        canvas = np.zeros((FINE * HEIGHT, FINE * WIDTH), np.uint8)
    else:
        canvas.fill(0)
    for corners in np.rint(fine).astype(np.int32):
        cv2.fillPoly(canvas, [corners], 255, lineType=cv2.LINE_8, shift=_FIXED_BITS)
    # Halving twice takes a quarter of the time of one reduction by four.
    half = cv2.resize(canvas, (2 * WIDTH, 2 * HEIGHT), interpolation=cv2.INTER_AREA)
    fraction: np.ndarray = cv2.resize(half, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    return fraction
