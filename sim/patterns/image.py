"""A pattern from any image: what is darker (or lighter) than a threshold is marker."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from scipy.ndimage import map_coordinates

from sim.checks import check_range
from sim.errors import SceneError
from sim.patterns.contour import contour, distance_to

Array = NDArray[np.float64]
Ink = Literal["dark", "light"]


@dataclass(frozen=True, slots=True, eq=False)
class ImagePattern:
    """Markers drawn by an image that lies over the middle of the gel, its first row at +y.

    The markers' edges lie where the grey level, linear between pixels, crosses the threshold:
    an image with soft edges places them to a fraction of its pixels. What reaches beyond the gel
    is cut off by it.

    Raises:
        SceneError: No image of two dimensions, levels that are not finite, a width or threshold
            out of range, or no marker at all.
    """

    name: str
    levels: Array
    """Grey levels (R, C)."""
    width: float
    """Width of the whole image on the gel [m], 1e-4 to 1; pixels are square."""
    threshold: float = 127.5
    """Grey level of the markers' edges."""
    ink: Ink = "dark"
    """Whether markers are darker or lighter than that."""

    def __post_init__(self) -> None:
        if self.levels.ndim != 2 or min(self.levels.shape) < 2:
            raise SceneError(
                f"pattern {self.name!r}.levels: shape {self.levels.shape}; allowed: (rows, columns)"
                ", at least 2 of each"
            )
        if not np.isfinite(self.levels).all():
            raise SceneError(f"pattern {self.name!r}.levels: not finite; allowed: finite numbers")
        check_range(f"pattern {self.name!r}", "width", self.width, 1e-4, 1.0, unit="m")
        check_range(f"pattern {self.name!r}", "threshold", self.threshold, -1e6, 1e6)
        if self.ink not in ("dark", "light"):
            raise SceneError(f"pattern {self.name!r}.ink: {self.ink!r}; allowed: dark, light")
        if not (self._depth < 0).any():
            raise SceneError(
                f"pattern {self.name!r}: no pixel {self.ink}er than {self.threshold:g}; levels run "
                f"from {self.levels.min():g} to {self.levels.max():g}"
            )

    @classmethod
    def read(
        cls,
        path: str | PathLike[str],
        *,
        width: float,
        threshold: float = 127.5,
        ink: Ink = "dark",
        name: str = "",
    ) -> ImagePattern:
        """The pattern that an image file (PNG, JPEG ...) shows; named after the file unless told.

        Raises:
            SceneError: What is no image, or is cut short; as the constructor.
            OSError: A file that cannot be read.
        """
        try:
            with Image.open(path) as image:
                levels = np.asarray(image.convert("L"), float)
        except FileNotFoundError:
            raise
        except (UnidentifiedImageError, OSError) as error:
            raise SceneError(f"pattern: {path}: no whole image ({error})") from error
        return cls(name or Path(path).stem, levels, width, threshold, ink)

    @property
    def pixel(self) -> float:
        """Width of a pixel on the gel [m]."""
        return self.width / int(self.levels.shape[1])

    def distance(self, x: Array, y: Array, band: float) -> Array:
        """Signed distance (Y, X) [m] to the markers' edges at x (X,) and y (Y,) [m].

        Exact up to `band` [m] either side, `band` beyond.
        """
        # A rim of background closes the edge of a marker that the image cuts.
        depth = np.pad(self._depth, 1, constant_values=float(np.abs(self._depth).max()))
        middle = (np.array(depth.shape) - 1) / 2
        column, row = np.meshgrid(x / self.pixel + middle[1], middle[0] - y / self.pixel)
        points = np.stack([column.ravel(), row.ravel()], axis=1)
        apart = distance_to(contour(depth), points, band / self.pixel).reshape(column.shape)
        inside = map_coordinates(depth, [row, column], order=1, mode="nearest") < 0
        return np.where(inside, -apart, apart) * self.pixel

    def check_within(self, size_x: float, size_y: float) -> None:
        """Any gel will do: it cuts off what lies beside it."""

    @property
    def _depth(self) -> Array:
        """Grey level beyond the threshold (R, C), negative in markers."""
        beyond = self.levels - self.threshold
        return np.asarray(beyond if self.ink == "dark" else -beyond)
