"""Parts of indenters: rounded closed paths of lines and arcs in a plane, and distances to them.

A path is a sequence of corners (u, v, bulge) with the material on its left. The bulge is
tan(angle / 4) of the arc from one corner to the next (the convention of DXF polylines): 0 is a
straight line, above 0 turns left (convex), below 0 turns right (concave).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, get_args

import numpy as np

from sim.arrays import Array
from sim.errors import SceneError, check_choice, check_range, is_finite, make_plain

Pair = tuple[float, float]

# Lengths below this are rounding errors [m].
POINT = 1e-12
# Changes of direction below this are rounding errors, not corners [rad].
_SMOOTH = 1e-6
# Number of steps in which a fillet grows to its radius.
_GROWTH = 8


@dataclass(frozen=True, slots=True)
class OutlinePiece:
    """Line or arc of a path."""

    start: Pair
    end: Pair
    bulge: float

    @property
    def angle(self) -> float:
        """Angle of the arc [rad], above 0 to the left; 0 for a line."""
        return 4 * math.atan(self.bulge)

    @property
    def length(self) -> float:
        """Length of the line or arc [m]."""
        chord = math.dist(self.start, self.end)
        return abs(self.radius * self.angle) if self.bulge else chord

    @property
    def radius(self) -> float:
        """Radius of the arc [m], below 0 when concave; inf for a line."""
        if not self.bulge:
            return math.inf
        return math.dist(self.start, self.end) * (1 + self.bulge**2) / (4 * self.bulge)

    @property
    def centre(self) -> Pair:
        """Centre of the arc [m]."""
        (u, v), (end_u, end_v) = self.start, self.end
        fraction = (1 - self.bulge**2) / (4 * self.bulge)
        return (u + end_u) / 2 - fraction * (end_v - v), (v + end_v) / 2 + fraction * (end_u - u)

    def tangent(self, *, end: bool) -> Pair:
        """Return the unit direction of travel at the start or the end."""
        heading = math.atan2(self.end[1] - self.start[1], self.end[0] - self.start[0])
        heading += self.angle / 2 if end else -self.angle / 2
        return math.cos(heading), math.sin(heading)

    def gap(self, point: Pair) -> tuple[float, Pair]:
        """Return the signed distance from the whole line or circle, and its gradient."""
        if not self.bulge:
            along_u, along_v = self.tangent(end=False)
            normal = (along_v, -along_u)
            from_u, from_v = point[0] - self.start[0], point[1] - self.start[1]
            return normal[0] * from_u + normal[1] * from_v, normal
        centre, sign = self.centre, math.copysign(1.0, self.bulge)
        length = math.dist(point, centre) or math.ulp(1.0)
        normal = (sign * (point[0] - centre[0]) / length, sign * (point[1] - centre[1]) / length)
        return sign * length - self.radius, normal

    def fraction(self, point: Pair) -> float:
        """Return the position of `point` on the line or circle: 0 at the start, 1 at the end."""
        if not self.bulge:
            along_u, along_v = self.tangent(end=False)
            from_u, from_v = point[0] - self.start[0], point[1] - self.start[1]
            return (along_u * from_u + along_v * from_v) / self.length
        centre = self.centre
        first = math.atan2(self.start[1] - centre[1], self.start[0] - centre[0])
        here = math.atan2(point[1] - centre[1], point[0] - centre[0])
        # Measured from the middle of the arc, so that both ends are well within (-pi, pi].
        middle = math.remainder(here - first - self.angle / 2, math.tau)
        return 0.5 + middle / self.angle


def check(values: Sequence[float]) -> None:
    """Check that values are a valid closed path."""
    if len(values) % 3 or len(values) < 6:
        raise SceneError(
            f"part.values: {len(values)} for a path; allowed: 3 for each of 2 or more corners"
        )
    path = pieces(values)
    for index, piece in enumerate(path):
        if piece.start == piece.end:
            raise SceneError(f"part.values: corner {index} twice; allowed: different neighbours")
    for index, piece in enumerate(path):
        if abs(_turn(path[index - 1], piece)) > math.pi - 1e-3:
            raise SceneError(f"part.values: turns back at corner {index}; allowed: an angle")


def pieces(values: Sequence[float]) -> list[OutlinePiece]:
    """Return the lines and arcs between the corners, closed back to the first."""
    corners = [tuple(values[index : index + 3]) for index in range(0, len(values), 3)]
    return [
        OutlinePiece(start=(u, v), end=(next_u, next_v), bulge=bulge)
        for (u, v, bulge), (next_u, next_v, _) in zip(
            corners, corners[1:] + corners[:1], strict=True
        )
    ]


def rounded(values: Sequence[float], radius: float) -> list[OutlinePiece] | None:
    """Return the path with an arc of `radius` in every convex corner; None if they do not fit."""
    sharp = pieces(values)
    if radius == 0:
        return sharp
    first, last = [0.0] * len(sharp), [1.0] * len(sharp)
    arcs: list[OutlinePiece | None] = []
    for index, after in enumerate(sharp):
        before = sharp[index - 1]
        fillet = None
        if _turn(before, after) > _SMOOTH:
            fillet = _fillet(before, after, radius)
            if fillet is None:
                return None
            last[index - 1] = before.fraction(fillet.start)
            first[index] = after.fraction(fillet.end)
        arcs.append(fillet)
    path: list[OutlinePiece] = []
    for index, piece in enumerate(sharp):
        ahead = arcs[index]
        behind = arcs[(index + 1) % len(sharp)]
        if not (first[index] >= 0 and last[index] <= 1 and first[index] <= last[index]):
            return None
        if ahead:
            path.append(ahead)
        start = ahead.end if ahead else piece.start
        end = behind.start if behind else piece.end
        if (last[index] - first[index]) * piece.length > POINT:
            bulge = math.tan(piece.angle * (last[index] - first[index]) / 4)
            path.append(OutlinePiece(start, end, bulge))
    return path


def fitted(values: tuple[float, ...], radius: float) -> list[OutlinePiece]:
    """Return the path with an arc of `radius` [m] in every convex corner."""
    path = rounded(values, radius)
    if path is None:
        raise SceneError(
            f"path: corners rounded to {radius!r} m; allowed: up to {radius_max(values):g} m"
        )
    return path


@lru_cache(maxsize=256)
def radius_max(values: tuple[float, ...]) -> float:
    """Return the largest radius [m] whose arcs fit in all convex corners; inf without any."""
    sharp = pieces(values)
    if all(_turn(sharp[index - 1], sharp[index]) <= _SMOOTH for index in range(len(sharp))):
        return math.inf
    low, high = 0.0, sum(piece.length for piece in sharp)
    while high - low > 1e-9 * high:
        middle = (low + high) / 2
        low, high = (low, middle) if rounded(values, middle) is None else (middle, high)
    return low


def extent(values: tuple[float, ...], radius: float) -> tuple[Pair, Pair]:
    """Return extremes of u and v of the rounded path [m]; infinite if material is outside."""
    points: list[Pair] = []
    area = 0.0
    for piece in fitted(values, radius):
        points.append(piece.start)
        area += (piece.start[0] * piece.end[1] - piece.end[0] * piece.start[1]) / 2
        if piece.bulge:
            (u, v), reach = piece.centre, abs(piece.radius)
            area += reach**2 * (piece.angle - math.sin(piece.angle)) / 2
            poles = [(u + reach, v), (u - reach, v), (u, v + reach), (u, v - reach)]
            points += [pole for pole in poles if 0 <= piece.fraction(pole) <= 1]
    if area < 0:
        return (-math.inf, math.inf), (-math.inf, math.inf)
    first, second = [point[0] for point in points], [point[1] for point in points]
    return (min(first), max(first)), (min(second), max(second))


def _turn(before: OutlinePiece, after: OutlinePiece) -> float:
    (u, v), (next_u, next_v) = before.tangent(end=True), after.tangent(end=False)
    return math.atan2(u * next_v - v * next_u, u * next_u + v * next_v)


def _fillet(before: OutlinePiece, after: OutlinePiece, radius: float) -> OutlinePiece | None:
    """Return the arc of `radius` that touches both pieces inside their corner, or None.

    Its centre is `radius` inside both. Newton's method finds it for radii that grow from 0, to
    follow the solution next to the corner.
    """
    u, v = before.end
    for step in range(1, _GROWTH + 1):
        wanted = radius * step / _GROWTH
        for _ in range(30):
            (gap_a, a), (gap_b, b) = before.gap((u, v)), after.gap((u, v))
            determinant = a[0] * b[1] - a[1] * b[0]
            if abs(determinant) < _SMOOTH:
                return None
            error_a, error_b = -wanted - gap_a, -wanted - gap_b
            shift_u = (error_a * b[1] - error_b * a[1]) / determinant
            shift_v = (error_b * a[0] - error_a * b[0]) / determinant
            u, v = u + shift_u, v + shift_v
            if math.hypot(shift_u, shift_v) < 1e-15 + 1e-13 * radius:
                break
        else:
            return None
    if max(abs(gap_a + radius), abs(gap_b + radius)) > 1e-9 * radius:
        return None
    start, end = (u + radius * a[0], v + radius * a[1]), (u + radius * b[0], v + radius * b[1])
    angle = math.atan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1])
    return OutlinePiece(start, end, math.tan(angle / 4)) if angle > 0 else None


# Exact signed distance from a rounded path, by a loop over rows of numbers.

# Kinds of rows.
LINE, ARC, CORNER = 0, 1, 2
# Numbers in a row.
ROW = 7


@lru_cache(maxsize=256)
def rows(values: tuple[float, ...], radius: float) -> Array:
    """Return the path with convex corners rounded to `radius` [m], as a table of numbers.

    Rows are (kind, u, v, direction u, direction v, size, cosine). For a line: start, direction and
    length. For an arc: centre, direction of its middle, radius (below 0 if concave) and cosine of
    half its angle. For a corner: position and mean outward normal. Corners come last.
    """
    path = fitted(values, radius)
    table: list[tuple[float, ...]] = []
    for piece in path:
        along = piece.tangent(end=False)
        if piece.bulge:
            sign = math.copysign(1.0, piece.bulge)
            middle = _rotated((sign * along[1], -sign * along[0]), piece.angle / 2)
            cosine = math.cos(piece.angle / 2)
            table.append((ARC, *piece.centre, *middle, piece.radius, cosine))
        else:
            table.append((LINE, *piece.start, *along, piece.length, 0.0))
    for index, piece in enumerate(path):
        before, after = path[index - 1].tangent(end=True), piece.tangent(end=False)
        mean = before[1] + after[1], -before[0] - after[0]
        length = math.hypot(*mean)
        table.append((CORNER, *piece.start, mean[0] / length, mean[1] / length, 0.0, 0.0))
    result = np.array(table)
    result.flags.writeable = False
    return result


def distance(table: Array, u: Array, v: Array) -> tuple[Array, Array, Array]:
    """Return the signed distance from the path (N,), and its gradient in u and in v.

    A corner counts only if it is nearer than every line and arc by more than rounding errors. The
    ill-conditioned direction of a corner is thus never used where pieces meet smoothly.
    """
    gap = np.full(u.shape, np.inf)
    normal_u, normal_v = np.ones_like(u), np.zeros_like(u)
    for kind, at_u, at_v, along_u, along_v, size, cosine in table:
        from_u, from_v = u - at_u, v - at_v
        if kind == LINE:
            fraction = along_u * from_u + along_v * from_v
            here = along_v * from_u - along_u * from_v
            nearer = (fraction >= 0) & (fraction <= size) & (np.abs(here) < np.abs(gap))
            here_u, here_v = np.full_like(u, along_v), np.full_like(u, -along_u)
        else:
            length = np.hypot(from_u, from_v)
            span = np.where(length > 0, length, 1.0)
            facing = along_u * from_u + along_v * from_v
            if kind == ARC:
                sign = np.copysign(1.0, size)
                here = sign * length - size
                nearer = (facing >= cosine * length) & (np.abs(here) < np.abs(gap))
                here_u = np.where(length > 0, sign * from_u / span, along_u)
                here_v = np.where(length > 0, sign * from_v / span, along_v)
            else:
                side = np.where(facing < 0, -1.0, 1.0)
                here = side * length
                nearer = length < np.abs(gap) - POINT
                apart = length > POINT
                here_u = np.where(apart, side * from_u / span, along_u)
                here_v = np.where(apart, side * from_v / span, along_v)
        gap = np.where(nearer, here, gap)
        normal_u, normal_v = np.where(nearer, here_u, normal_u), np.where(nearer, here_v, normal_v)
    return gap, normal_u, normal_v


def _rotated(pair: Pair, angle: float) -> Pair:
    cosine, sine = math.cos(angle), math.sin(angle)
    return cosine * pair[0] - sine * pair[1], sine * pair[0] + cosine * pair[1]


# Part of an indenter: a plane figure, extruded from plan or side view, or revolved.

Interval = tuple[float, float]
# Least and greatest x, y and z [m]; infinite if unbounded.
Bounds = tuple[Interval, Interval, Interval]

View = Literal["plan", "side", "turned"]
Figure = Literal["half_plane", "band", "circle", "path"]
Join = Literal["union", "intersect", "subtract"]
VIEWS: tuple[View, ...] = get_args(View)
FIGURES: tuple[Figure, ...] = get_args(Figure)
JOINS: tuple[Join, ...] = get_args(Join)

LENGTHS = {"half_plane": 3, "band": 4, "circle": 3}


@dataclass(frozen=True, slots=True)
class Part:
    """Figure in a plane (u, v), swept through space and joined to the parts before it.

    The view defines u and v: `plan` is (x, y), extruded along z; `side` is (x, z), extruded along
    y; `turned` is (distance from `axis`, z), a body of revolution. The distance to the figure is
    exactly the distance to the swept body.

    Raises:
        SceneError: A name is unknown, or the values do not define a figure.
    """

    view: View
    figure: Figure
    values: tuple[float, ...]
    """`half_plane`: outward unit normal (2), offset: the material is where normal . (u, v) <=
    offset. `band`: unit normal (2), offset of the middle, half the width. `circle`: centre (2),
    radius. `path`: corners (u, v, bulge) in turn, the material on the left, bulge = tan(angle / 4)
    of the arc to the next corner: 0 is straight, above 0 turns left. Lengths in [m]."""
    join: Join = "intersect"
    """`union` adds the part, `intersect` keeps the common volume, `subtract` removes the part;
    edges created by the last two are rounded."""
    axis: tuple[float, float] = (0.0, 0.0)
    """Position of the axis of a `turned` part, x and y [m]."""
    cosine: float = 0.0
    """Cosine between this part's outward normal and the others' along the edge they form: 0 for a
    right angle. Edges of plane and conical faces are rounded to true arcs only if it is correct."""

    def __post_init__(self) -> None:
        make_plain(self)
        check_choice("part.view", self.view, VIEWS)
        check_choice("part.figure", self.figure, FIGURES)
        check_choice("part.join", self.join, JOINS)
        if not isinstance(self.values, tuple) or not all(map(is_finite, self.values)):
            raise SceneError(f"part.values: {self.values!r}; allowed: finite numbers")
        if len(self.axis) != 2:
            raise SceneError(f"part.axis: {self.axis!r}; allowed: x and y [m]")
        for index, value in enumerate(self.axis):
            check_range("part", f"axis[{index}]", value, -1.0, 1.0, unit="m")
        check_range("part", "cosine", self.cosine, -0.999, 0.999)
        if self.figure == "path":
            if self.join == "subtract":
                raise SceneError(
                    "part.join: 'subtract' of a path; allowed: 'intersect' with the path drawn the "
                    "other way round, so that the material stays on its left"
                )
            check(self.values)
            return
        count = LENGTHS[self.figure]
        if len(self.values) != count:
            raise SceneError(
                f"part.values: {len(self.values)} for a {self.figure}; allowed: {count}"
            )
        if self.figure in ("band", "circle") and not self.values[-1] > 0:
            raise SceneError(f"part.values[-1]: {self.values[-1]!r} m; allowed: above 0")
        if self.figure != "circle" and abs(math.hypot(*self.values[:2]) - 1) > 1e-9:
            raise SceneError(f"part.values: normal {self.values[:2]!r}; allowed: length 1")

    def distance(self, points: Array, radius: float) -> tuple[Array, Array]:
        """Return the part's signed distance (N,) and gradient (N, 3) at points (N, 3).

        `radius` [m] rounds the convex corners of a path; nothing else of a single part is rounded.
        """
        x, y, z = points[:, 0], points[:, 1], points[:, 2]
        if self.view == "turned":
            east, north = x - self.axis[0], y - self.axis[1]
            u = np.hypot(east, north)
            off_axis = u > 0
            span = np.where(off_axis, u, 1.0)
            east, north = np.where(off_axis, east / span, 1.0), north / span
            gap, normal_u, normal_v = self._plane(u, z, radius)
            return gap, np.stack([normal_u * east, normal_u * north, normal_v], axis=1)
        flat = np.zeros(len(points))
        if self.view == "plan":
            gap, normal_u, normal_v = self._plane(x, y, radius)
            return gap, np.stack([normal_u, normal_v, flat], axis=1)
        gap, normal_u, normal_v = self._plane(x, z, radius)
        return gap, np.stack([normal_u, flat, normal_v], axis=1)

    def _plane(self, u: Array, v: Array, radius: float) -> tuple[Array, Array, Array]:
        if self.figure == "path":
            return distance(rows(self.values, radius), u, v)
        first, second, third = self.values[:3]
        if self.figure == "circle":
            from_u, from_v = u - first, v - second
            length = np.hypot(from_u, from_v)
            span = np.where(length > 0, length, 1.0)
            return length - third, np.where(length > 0, from_u / span, 1.0), from_v / span
        height = first * u + second * v - third
        if self.figure == "half_plane":
            return height, np.full_like(u, first), np.full_like(u, second)
        side = np.where(height < 0, -1.0, 1.0)
        return np.abs(height) - self.values[3], side * first, side * second

    @property
    def edge_radius_max(self) -> float:
        """Largest radius [m] to which the part's edges can be rounded; inf if unlimited."""
        if self.join == "subtract":
            return math.inf
        if self.figure in ("band", "circle"):
            return self.values[-1]
        if self.figure == "path":
            return radius_max(self.values)
        normal_u, _, offset = self.values
        if self.view == "turned" and normal_u > 0:
            # The fillet of two straight faces extends radius * sqrt((1 - c) / (1 + c)) inwards
            # from their edge, at most to the axis.
            return max(0.0, offset / normal_u) * math.sqrt((1 + self.cosine) / (1 - self.cosine))
        return math.inf

    def bounds(self, radius: float) -> Bounds:
        """Return the part's bounds in x, y and z [m] with its corners rounded to `radius`."""
        along_u, along_v = self._extent(radius)
        if self.view == "plan":
            return along_u, along_v, EVERYWHERE
        if self.view == "side":
            return along_u, EVERYWHERE, along_v
        (x, y), reach = self.axis, along_u[1]
        return (x - reach, x + reach), (y - reach, y + reach), along_v

    def _extent(self, radius: float) -> tuple[Interval, Interval]:
        if self.figure == "path":
            return extent(self.values, radius)
        if self.figure == "circle":
            u, v, round_radius = self.values
            return (u - round_radius, u + round_radius), (v - round_radius, v + round_radius)
        normal_u, normal_v, offset = self.values[:3]
        low = offset - self.values[3] if self.figure == "band" else -math.inf
        high = offset + self.values[3] if self.figure == "band" else offset
        return _between(normal_u, low, high), _between(normal_v, low, high)


EVERYWHERE: Interval = (-math.inf, math.inf)


def _between(normal: float, low: float, high: float) -> Interval:
    """Return the range of a coordinate with `low` <= normal * it <= `high`, for normals of +-1."""
    if normal == 1:
        return low, high
    return (-high, -low) if normal == -1 else EVERYWHERE
