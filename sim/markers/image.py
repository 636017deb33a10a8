"""Marker pattern from an image: areas darker (or lighter) than a threshold are markers."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from sim.errors import SceneError, check_range
from sim.scene import Body

# Subpixel contour of an image at a threshold, and the distance to it.

Array = NDArray[np.float64]

# Candidate segments for each point, since the segment with the nearest middle need not be nearest.
NEAREST = 4
_TOP, _RIGHT, _BOTTOM, _LEFT = range(4)


def contour(level: Array) -> Array:
    """Return segments (n, 2, 2) of the zero contour of `level` (R, C), as (column, row) of ends.

    This is marching squares: values are at pixel centres (integers) and linear between neighbours.
    In a cell with two opposite corners inside, the mean of its corners decides if they are joined.
    """
    row, column = np.indices(level.shape, dtype=float)
    across = _crossings(level[:, :-1], level[:, 1:])
    down = _crossings(level[:-1], level[1:])
    on_rows = np.stack([column[:, :-1] + across, row[:, :-1]], axis=-1)
    on_columns = np.stack([column[:-1], row[:-1] + down], axis=-1)
    crossed = np.stack(
        [
            np.isfinite(across[:-1]),
            np.isfinite(down[:, 1:]),
            np.isfinite(across[1:]),
            np.isfinite(down[:, :-1]),
        ],
        axis=-1,
    )
    cells = np.nonzero(crossed.any(axis=-1))
    edges = crossed[cells]
    r, c = cells
    ends = np.stack([on_rows[r, c], on_columns[r, c + 1], on_rows[r + 1, c], on_columns[r, c]], 1)
    saddle = edges.all(axis=-1)
    plain = np.nonzero(~saddle)[0]
    first = edges[plain].argmax(axis=1)
    last = 3 - edges[plain, ::-1].argmax(axis=1)
    segments = [np.stack([ends[plain, first], ends[plain, last]], axis=1)]
    mean = (level[:-1, :-1] + level[:-1, 1:] + level[1:, :-1] + level[1:, 1:])[cells]
    joined = (mean < 0) == (level[:-1, :-1][cells] < 0)
    # If joined, the cell's middle belongs to the upper left corner and its opposite.
    for which, pairs in (
        (saddle & joined, ((_TOP, _RIGHT), (_BOTTOM, _LEFT))),
        (saddle & ~joined, ((_TOP, _LEFT), (_BOTTOM, _RIGHT))),
    ):
        segments += [ends[which][:, pair] for pair in pairs]
    return np.concatenate(segments)


def distance_to(segments: Array, points: Array, limit: float) -> Array:
    """Return the distance (m,) from points (m, 2) to the nearest segment (n, 2, 2), up to `limit`.

    It is exact if no segment is longer than the gap between its neighbours, as in a contour.
    """
    found = np.full(len(points), limit)
    if not len(segments):
        return found
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    length = np.hypot(along[:, 0], along[:, 1])
    near, index = cKDTree(start + along / 2).query(
        points, k=NEAREST, distance_upper_bound=limit + length.max() / 2
    )
    for rank in range(NEAREST):
        inside = np.nonzero(np.isfinite(near[:, rank]))[0]
        chosen = index[inside, rank]
        offset = points[inside] - start[chosen]
        size = np.maximum(length[chosen] ** 2, np.finfo(float).tiny)
        fraction = np.clip((offset * along[chosen]).sum(axis=1) / size, 0, 1)
        beside = offset - fraction[:, None] * along[chosen]
        found[inside] = np.minimum(found[inside], np.hypot(beside[:, 0], beside[:, 1]))
    return found


def _crossings(before: Array, after: Array) -> Array:
    """Return the fraction of the way between neighbours at which the sign changes, or NaN.

    0 counts as outside.
    """
    crosses = (before < 0) != (after < 0)
    change = np.where(crosses, before - after, 1.0)
    return np.where(crosses, before / change, np.nan)


Ink = Literal["dark", "light"]


@dataclass(frozen=True, slots=True, eq=False)
class ImagePattern:
    """Markers defined by an image, centred on the gel with its first row at +y.

    Edges of markers lie where the grey level, linear between pixels, crosses the threshold, so that
    images with soft edges give subpixel positions. Markers are clipped at the border of the gel.

    Raises:
        SceneError: The image is not two-dimensional, levels are not finite, width or threshold is
            out of range, or there is no marker.
    """

    name: str
    levels: Array
    """Grey levels (R, C)."""
    width: float
    """Width of the whole image on the gel [m], 1e-4 to 1; pixels are square."""
    threshold: float = 127.5
    """Grey level of the markers' edges."""
    ink: Ink = "dark"
    """`dark` if markers are darker than the threshold, `light` if lighter."""

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
        """Read a pattern from an image file (PNG, JPEG ...), named after the file by default.

        Raises:
            SceneError: The file is no image or truncated; or as the constructor.
            OSError: The file cannot be read.
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
        """Return the signed distance (Y, X) [m] to the markers' edges at x (X,) and y (Y,) [m].

        It is exact up to `band` [m] on either side, and `band` beyond.
        """
        # A border of background closes the edges of markers that the image clips.
        depth = np.pad(self._depth, 1, constant_values=float(np.abs(self._depth).max()))
        middle = (np.array(depth.shape) - 1) / 2
        column, row = np.meshgrid(x / self.pixel + middle[1], middle[0] - y / self.pixel)
        points = np.stack([column.ravel(), row.ravel()], axis=1)
        apart = distance_to(contour(depth), points, band / self.pixel).reshape(column.shape)
        inside = map_coordinates(depth, [row, column], order=1, mode="nearest") < 0
        return np.where(inside, -apart, apart) * self.pixel

    def check_within(self, body: Body) -> None:
        """Accept any gel, as markers are clipped at its border."""

    @property
    def _depth(self) -> Array:
        """Grey level relative to the threshold (R, C), negative in markers."""
        beyond = self.levels - self.threshold
        return np.asarray(beyond if self.ink == "dark" else -beyond)
