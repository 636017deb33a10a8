"""Marker patterns as data: a shape, a size, and the positions of its copies on the gel."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Self, get_args

import numpy as np

from sim.arrays import Array
from sim.errors import SceneError, check_choice, check_range
from sim.scene import Body

Shape = Literal["disc", "square", "diamond"]
Place = tuple[float, float]

# Tolerance for markers that extend beyond the gel by rounding [m].
ROUND_OFF = 1e-9


@dataclass(frozen=True, slots=True)
class Pattern:
    """Equal markers on the undeformed top of a gel, in the contact frame.

    Raises:
        SceneError: The shape is unknown, a size or place is out of range, or there is no marker.
    """

    name: str
    shape: Shape
    """Shape of the markers; a diamond is a square rotated by 45 degrees."""
    size: float = field(metadata={"unit": "mm"})
    """Width of a marker along x before rotation [m], 1e-5 to 0.1: a disc's diameter, a square's
    side, a diamond's diagonal."""
    places: tuple[Place, ...] = field(metadata={"unit": "mm"})
    """Centres of the markers (x, y) [m]."""
    angle: float = field(default=0.0, metadata={"unit": "deg"})
    """Rotation of each marker about its centre, anticlockwise [rad], up to pi."""

    def __post_init__(self) -> None:
        check_choice("pattern.shape", self.shape, get_args(Shape))
        check_range("pattern", "size", self.size, 1e-5, 0.1, unit="m")
        check_range("pattern", "angle", self.angle, -math.pi, math.pi, unit="rad")
        if not self.places:
            raise SceneError("pattern.places: none; allowed: at least one marker")
        for index, centre in enumerate(self.places):
            if len(centre) != 2:
                raise SceneError(f"pattern.places[{index}]: {centre!r}; allowed: (x, y)")
            for value in centre:
                check_range("pattern", f"places[{index}]", value, -1.0, 1.0, unit="m")

    def __len__(self) -> int:
        return len(self.places)

    @property
    def centres(self) -> Array:
        """Centres of the markers (n, 2) [m]."""
        return np.array(self.places)

    @property
    def reach(self) -> float:
        """Half the extent of a marker along x, and along y [m]."""
        if self.shape == "disc":
            return self.size / 2
        half, angle = self.square
        return half * (abs(math.cos(angle)) + abs(math.sin(angle)))

    def moved(self, shift: Place = (0.0, 0.0), angle: float = 0.0, *, name: str = "") -> Self:
        """Return the pattern rotated by `angle` [rad] about the gel's middle, then shifted [m]."""
        centres = tuple((x + shift[0], y + shift[1]) for x, y in turned(self.places, angle))
        return replace(self, name=name or self.name, places=centres, angle=self.angle + angle)

    def marker_distance(self, offset: Array) -> Array:
        """Return the signed distance (...) [m] to a marker at offsets (..., 2) [m] from its centre.

        It is negative inside.
        """
        if self.shape == "disc":
            return np.asarray(np.hypot(offset[..., 0], offset[..., 1]) - self.size / 2)
        half, angle = self.square
        cosine, sine = math.cos(angle), math.sin(angle)
        x, y = offset[..., 0], offset[..., 1]
        beyond_x = np.abs(cosine * x + sine * y) - half
        beyond_y = np.abs(cosine * y - sine * x) - half
        outside = np.hypot(np.maximum(beyond_x, 0), np.maximum(beyond_y, 0))
        return np.asarray(outside + np.minimum(np.maximum(beyond_x, beyond_y), 0))

    def distance(self, x: Array, y: Array, band: float) -> Array:
        """Return the signed distance (Y, X) [m] to the nearest marker at ascending x, y [m].

        It is exact up to `band` [m] outside the markers, and `band` beyond.
        """
        nearest = np.full((len(y), len(x)), band)
        reach = self.reach + band
        for centre_x, centre_y in self.places:
            columns = slice(*np.searchsorted(x, [centre_x - reach, centre_x + reach]))
            rows = slice(*np.searchsorted(y, [centre_y - reach, centre_y + reach]))
            offset_x, offset_y = np.meshgrid(x[columns] - centre_x, y[rows] - centre_y)
            distance = self.marker_distance(np.stack([offset_x, offset_y], axis=-1))
            nearest[rows, columns] = np.minimum(nearest[rows, columns], distance)
        return nearest

    def within(self, body: Body) -> Self:
        """Return the markers that lie wholly on a gel.

        Raises:
            SceneError: None do.
        """
        room = body.from_side(*self.centres.T) - self.reach
        inside = (centre for centre, on in zip(self.places, room >= 0, strict=True) if on)
        return replace(self, places=tuple(inside))

    def check_within(self, body: Body) -> None:
        """Check that all markers lie wholly on a gel.

        Raises:
            SceneError: Some do not; the message names the marker that extends furthest.
        """
        room = body.from_side(*self.centres.T) - self.reach
        worst = int(room.argmin())
        if room[worst] < -ROUND_OFF:
            x, y = (1e3 * value for value in self.places[worst])
            outline = " ellipse" if body.footprint == "ellipse" else ""
            raise SceneError(
                f"pattern {self.name!r}: the marker of {self.size * 1e3:.4g} mm at x {x:.4g}, y "
                f"{y:.4g} mm reaches beyond the gel; allowed: markers wholly on its "
                f"{body.size_x * 1e3:.4g} x {body.size_y * 1e3:.4g} mm{outline}"
            )

    @property
    def square(self) -> tuple[float, float]:
        """Half the side of a square or diamond marker [m], and its angle [rad]."""
        if self.shape == "square":
            return self.size / 2, self.angle
        return self.size / (2 * math.sqrt(2)), self.angle + math.pi / 4


# Marker positions: rows, staggered rows, rings and hexagons, all about the gel's middle.


def rows(columns: int, count: int, pitch: float, row_pitch: float | None = None) -> list[Place]:
    """Return `count` rows of `columns` markers, `pitch` apart along x, `row_pitch` along y [m]."""
    across = _centred(columns, pitch)
    return [(x, y) for y in _centred(count, row_pitch or pitch) for x in across]


def staggered(
    columns: int, count: int, pitch: float, row_pitch: float, *, shorter: bool
) -> list[Place]:
    """Return `count` rows, every other one offset by half a pitch [m].

    With `shorter`, offset rows have one marker less and all rows are centred; otherwise all rows
    are equal and are shifted by a quarter of the pitch to the left or to the right.
    """
    centres = []
    for index, y in enumerate(_centred(count, row_pitch)):
        aside = index % 2 == 1
        if shorter:
            row = _centred(columns - aside, pitch)
        else:
            shift = pitch / 4 if aside else -pitch / 4
            row = [x + shift for x in _centred(columns, pitch)]
        centres += [(x, y) for x in row]
    return centres


def rings(counts: Sequence[int], spacing: float, *, middle: bool) -> list[Place]:
    """Return rings about the middle, `spacing` [m] apart, of `counts` evenly spaced markers.

    Every other ring is rotated by half a gap, so that its markers do not line up with its
    neighbours'. `middle` adds one in the middle.
    """
    if any(count < 1 for count in counts):
        raise SceneError(f"rings: {tuple(counts)!r}; allowed: at least 1 marker each")
    centres = [(0.0, 0.0)] if middle else []
    for index, count in enumerate(counts):
        radius = (index + 1) * spacing
        first = (index % 2) * math.pi / count
        turns = [first + 2 * math.pi * number / count for number in range(count)]
        centres += [(radius * math.cos(turn), radius * math.sin(turn)) for turn in turns]
    return centres


def hexagon(ring_count: int, pitch: float) -> list[Place]:
    """Return a triangular lattice of `pitch` [m] within a hexagon of `ring_count` rings.

    It has 1 + 3 n (n + 1) places for n rings: 127 for 6.
    """
    reach = range(-ring_count, ring_count + 1)
    axial = [(q, r) for r in reach for q in reach if abs(q + r) <= ring_count]
    height = math.sqrt(3) / 2
    return [(pitch * (q + r / 2), pitch * r * height) for q, r in axial]


def turned(places: Sequence[Place], angle: float) -> list[Place]:
    """Return the places rotated about the middle by `angle` [rad], anticlockwise."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return [(cosine * x - sine * y, sine * x + cosine * y) for x, y in places]


def _centred(count: int, pitch: float) -> list[float]:
    if count < 1:
        raise SceneError(f"markers in a row: {count!r}; allowed: at least 1")
    return [(index - (count - 1) / 2) * pitch for index in range(count)]


# The patterns by name: the paper's 12 simulated ones, its GelSights, TacPalm's pins.
#
# Of the authors' textures only the number of markers is known (225, 100, 80, 99; 320, 115, 111,
# 124; 245, 100, 81, 81, over the whole gel of 20 x 20 mm). Everything else here is assumed: "array"
# is rows and columns, "circle" is rings of discs about the middle, "diamond" is diamonds in rotated
# or staggered lattices. Markers are 25 to 45 % as wide as they are apart, and no row crosses the
# upper or lower border of the paper's image.
#
# Of the real GelSights the pitch of 2.4 mm is known (5 rows of 7 in view), and that two of them had
# their elastomer shifted or rotated; shape, size and amounts are assumed. Of the GelSight that is
# compared with other sensors, it is known that 56 markers are in view. "Mini" has the 7 x 9 dots of
# GelSight Mini, as its vendor's marker tracker (gsrobotics) counts them.

MM = 1e-3
# Shift [m] and rotation [rad] from Array-I to Array-II.
MOVED: tuple[Place, float] = ((0.55 * MM, -0.4 * MM), math.radians(3.0))
# The same for the circles.
MOVED_CIRCLE: tuple[Place, float] = ((-0.45 * MM, 0.5 * MM), math.radians(-4.0))


def _pattern(name: str, shape: Shape, size_mm: float, places: Sequence[Place]) -> Pattern:
    return Pattern(name, shape, size_mm * MM, tuple(places))


_ARRAY = _pattern("Array-I", "disc", 0.70, rows(7, 7, 2.4 * MM))
_CIRCLE = _pattern("Circle-I", "disc", 0.70, rings((6, 12, 18, 24), 2.1 * MM, middle=True))

_PATTERNS = (
    _pattern("Array1", "disc", 0.50, rows(15, 15, 1.30 * MM)),
    _pattern("Array2", "square", 0.70, rows(10, 10, 1.95 * MM)),
    _pattern("Array3", "disc", 0.80, rows(10, 8, 1.90 * MM, 2.10 * MM)),
    _pattern("Array4", "square", 0.50, rows(11, 9, 1.75 * MM, 1.90 * MM)),
    _pattern(
        "Circle1",
        "disc",
        0.36,
        rings((6, 12, 17, 23, 29, 35, 41, 46, 52, 58), 0.96 * MM, middle=True),
    ),
    _pattern("Circle2", "disc", 0.55, rings((4, 8, 12, 16, 20, 25, 29), 1.32 * MM, middle=True)),
    _pattern("Circle3", "disc", 0.66, rings((5, 11, 16, 21, 26, 32), 1.55 * MM, middle=False)),
    _pattern("Circle4", "disc", 0.42, rings((6, 12, 18, 23, 29, 35), 1.55 * MM, middle=True)),
    _pattern("Diamond1", "diamond", 0.45, staggered(18, 14, 1.08 * MM, 1.38 * MM, shorter=True)),
    _pattern("Diamond2", "diamond", 0.60, turned(rows(10, 10, 1.46 * MM), math.pi / 4)),
    _pattern("Diamond3", "diamond", 0.72, turned(rows(9, 9, 1.63 * MM), math.pi / 4)),
    _pattern("Diamond4", "diamond", 0.85, staggered(9, 9, 2.08 * MM, 1.88 * MM, shorter=False)),
    _ARRAY,
    _ARRAY.moved(*MOVED, name="Array-II"),
    _CIRCLE,
    _CIRCLE.moved(*MOVED_CIRCLE, name="Circle-II"),
    _pattern("Diamond-I", "diamond", 0.80, staggered(6, 11, 3.4 * MM, 1.7 * MM, shorter=True)),
    _pattern("GelSight", "disc", 0.60, rows(8, 7, 1.75 * MM)),
    _pattern("TacPalm", "disc", 1.10, hexagon(6, 2.6 * MM)),
    _pattern("Mini", "disc", 0.50, rows(9, 7, 1.9 * MM)),
)
_BY_NAME = {pattern.name: pattern for pattern in _PATTERNS}

NAMES = tuple(_BY_NAME)
# The paper's 12 simulated patterns.
SIMULATED = NAMES[:12]
# The five GelSights of the paper's homogeneous test.
HOMOGENEOUS = NAMES[12:17]


def named(name: str) -> Pattern:
    """Return the pattern of that name.

    Raises:
        SceneError: The name is unknown.
    """
    if name not in _BY_NAME:
        raise SceneError(f"pattern: {name!r}; allowed: {', '.join(NAMES)}")
    return _BY_NAME[name]
