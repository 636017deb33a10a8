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
from scipy.spatial import cKDTree

from sim.errors import SceneError, check_range
from sim.scene import Body

# The contour of an image at a threshold, to a fraction of a pixel, and the distance to it.

Array = NDArray[np.float64]

# Segments looked at for each point: the nearest middle need not be that of the nearest segment.
NEAREST = 4
_TOP, _RIGHT, _BOTTOM, _LEFT = range(4)


def contour(level: Array) -> Array:
    """Segments (n, 2, 2) of the zero contour of `level` (R, C), as (column, row) of their ends.

    Marching squares: values lie at pixel centres (whole numbers) and are linear along the lines
    between neighbours. A cell with two opposite corners inside is joined or split by the mean of
    its corners.
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
    # The middle belongs to the upper left corner and the one across: the others are cut off.
    for which, pairs in (
        (saddle & joined, ((_TOP, _RIGHT), (_BOTTOM, _LEFT))),
        (saddle & ~joined, ((_TOP, _LEFT), (_BOTTOM, _RIGHT))),
    ):
        segments += [ends[which][:, pair] for pair in pairs]
    return np.concatenate(segments)


def distance_to(segments: Array, points: Array, limit: float) -> Array:
    """Distance (m,) from points (m, 2) to the nearest of the segments (n, 2, 2), `limit` at most.

    Exact where no segment is longer than what is between its neighbours, as those of a contour are.
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
        share = np.clip((offset * along[chosen]).sum(axis=1) / size, 0, 1)
        beside = offset - share[:, None] * along[chosen]
        found[inside] = np.minimum(found[inside], np.hypot(beside[:, 0], beside[:, 1]))
    return found


def _crossings(before: Array, after: Array) -> Array:
    """Where between two neighbours the sign changes, as a share of the way; NaN where it does not.

    0 counts as outside.
    """
    crosses = (before < 0) != (after < 0)
    change = np.where(crosses, before - after, 1.0)
    return np.where(crosses, before / change, np.nan)


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

    def check_within(self, body: Body) -> None:
        """Any gel will do: it cuts off what lies beside it."""

    @property
    def _depth(self) -> Array:
        """Grey level beyond the threshold (R, C), negative in markers."""
        beyond = self.levels - self.threshold
        return np.asarray(beyond if self.ink == "dark" else -beyond)
