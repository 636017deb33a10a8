"""A pattern of markers as data: one shape, one size, and where its copies lie on the gel."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from sim.checks import check_range
from sim.errors import SceneError

Array = NDArray[np.float64]
Shape = Literal["disc", "square", "diamond"]
Place = tuple[float, float]

SHAPES = get_args(Shape)
ROUND_OFF = 1e-9
"""What a marker may reach beyond the gel by rounding [m]."""


@dataclass(frozen=True, slots=True)
class Pattern:
    """Equal markers on the untouched top of a gel, in the contact frame.

    Raises:
        SceneError: A shape that is unknown, a size or place that is out of range, or no marker.
    """

    name: str
    shape: Shape
    """A diamond is a square that stands on a corner."""
    size: float
    """Width of a marker along x before any turn [m]: a disc's diameter, a square's side, a
    diamond's diagonal; 1e-5 to 0.1."""
    places: tuple[Place, ...]
    """Centres of the markers (x, y) [m]."""
    angle: float = 0.0
    """How far each marker is turned about its centre, anticlockwise [rad], up to pi."""

    def __post_init__(self) -> None:
        if self.shape not in SHAPES:
            raise SceneError(f"pattern.shape: {self.shape!r}; allowed: {', '.join(SHAPES)}")
        check_range("pattern", "size", self.size, 1e-5, 0.1, unit="m")
        check_range("pattern", "angle", self.angle, -math.pi, math.pi, unit="rad")
        if not self.places:
            raise SceneError("pattern.places: none; allowed: at least one marker")
        for index, place in enumerate(self.places):
            if len(place) != 2:
                raise SceneError(f"pattern.places[{index}]: {place!r}; allowed: (x, y)")
            for value in place:
                check_range("pattern", f"places[{index}]", value, -1.0, 1.0, unit="m")

    def __len__(self) -> int:
        """Number of markers."""
        return len(self.places)

    @property
    def centres(self) -> Array:
        """Centres of the markers (n, 2) [m]."""
        return np.array(self.places)

    @property
    def reach(self) -> float:
        """How far a marker reaches from its centre along x, and along y [m]."""
        if self.shape == "disc":
            return self.size / 2
        half, angle = self._square
        return half * (abs(math.cos(angle)) + abs(math.sin(angle)))

    def moved(self, shift: Place = (0.0, 0.0), angle: float = 0.0, *, name: str = "") -> Pattern:
        """The pattern turned by `angle` [rad] about the gel's middle, then shifted [m]."""
        cosine, sine = math.cos(angle), math.sin(angle)
        places = tuple(
            (cosine * x - sine * y + shift[0], sine * x + cosine * y + shift[1])
            for x, y in self.places
        )
        return replace(self, name=name or self.name, places=places, angle=self.angle + angle)

    def marker_distance(self, offset: Array) -> Array:
        """Signed distance (...) [m] of points to one marker, given from its centre (..., 2) [m].

        Negative inside.
        """
        if self.shape == "disc":
            return np.asarray(np.hypot(offset[..., 0], offset[..., 1]) - self.size / 2)
        half, angle = self._square
        cosine, sine = math.cos(angle), math.sin(angle)
        x, y = offset[..., 0], offset[..., 1]
        beyond_x = np.abs(cosine * x + sine * y) - half
        beyond_y = np.abs(cosine * y - sine * x) - half
        outside = np.hypot(np.maximum(beyond_x, 0), np.maximum(beyond_y, 0))
        return np.asarray(outside + np.minimum(np.maximum(beyond_x, beyond_y), 0))

    def distance(self, x: Array, y: Array, band: float) -> Array:
        """Signed distance (Y, X) [m] to the nearest marker at rising x (X,) and y (Y,) [m].

        Exact up to `band` [m] outside of the markers, `band` beyond.
        """
        found = np.full((len(y), len(x)), band)
        reach = self.reach + band
        for centre_x, centre_y in self.places:
            columns = slice(*np.searchsorted(x, [centre_x - reach, centre_x + reach]))
            rows = slice(*np.searchsorted(y, [centre_y - reach, centre_y + reach]))
            offset_x, offset_y = np.meshgrid(x[columns] - centre_x, y[rows] - centre_y)
            distance = self.marker_distance(np.stack([offset_x, offset_y], axis=-1))
            found[rows, columns] = np.minimum(found[rows, columns], distance)
        return found

    def check_within(self, size_x: float, size_y: float) -> None:
        """Refuse a gel (of `size_x` by `size_y` [m]) that some marker does not lie wholly on.

        Raises:
            SceneError: Names the marker that reaches furthest.
        """
        room = np.array([size_x, size_y]) / 2 - self.reach - np.abs(self.centres)
        worst = int(room.min(axis=1).argmin())
        if room[worst].min() < -ROUND_OFF:
            x, y = (1e3 * value for value in self.places[worst])
            raise SceneError(
                f"pattern {self.name!r}: the marker of {self.size * 1e3:.4g} mm at x {x:.4g}, y "
                f"{y:.4g} mm reaches beyond the gel; allowed: markers wholly on its "
                f"{size_x * 1e3:.4g} x {size_y * 1e3:.4g} mm"
            )

    @property
    def _square(self) -> tuple[float, float]:
        """Half the side of the marker, and its angle, for a square or a diamond."""
        if self.shape == "square":
            return self.size / 2, self.angle
        return self.size / (2 * math.sqrt(2)), self.angle + math.pi / 4
