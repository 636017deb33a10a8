"""Closed paths of lines and arcs in a plane, and the rounding of their corners.

A path is given by its corners (u, v, bulge) in turn, the material on its left. The bulge is
tan(angle / 4) of the arc from one corner to the next (the convention of DXF polylines): 0 is a
straight line, above 0 turns left (convex), below 0 turns right (concave).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

from sim.errors import SceneError

Pair = tuple[float, float]

POINT = 1e-12
"""Lengths below this are rounding [m]."""
_SMOOTH = 1e-6
"""Turns below this are rounding, not corners [rad]."""
_GROWTH = 8
"""Steps in which a fillet grows to its radius."""


@dataclass(frozen=True, slots=True)
class Piece:
    """One line or arc of a path."""

    start: Pair
    end: Pair
    bulge: float

    @property
    def angle(self) -> float:
        """How far the arc turns [rad]; above 0 to the left, 0 for a line."""
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
        share = (1 - self.bulge**2) / (4 * self.bulge)
        return (u + end_u) / 2 - share * (end_v - v), (v + end_v) / 2 + share * (end_u - u)

    def tangent(self, *, end: bool) -> Pair:
        """Unit direction of travel at the start or the end."""
        heading = math.atan2(self.end[1] - self.start[1], self.end[0] - self.start[0])
        heading += self.angle / 2 if end else -self.angle / 2
        return math.cos(heading), math.sin(heading)

    def gap(self, point: Pair) -> tuple[float, Pair]:
        """Signed distance from the whole line or circle, and its gradient."""
        if not self.bulge:
            along_u, along_v = self.tangent(end=False)
            normal = (along_v, -along_u)
            from_u, from_v = point[0] - self.start[0], point[1] - self.start[1]
            return normal[0] * from_u + normal[1] * from_v, normal
        centre, sign = self.centre, math.copysign(1.0, self.bulge)
        length = math.dist(point, centre) or math.ulp(1.0)
        normal = (sign * (point[0] - centre[0]) / length, sign * (point[1] - centre[1]) / length)
        return sign * length - self.radius, normal

    def share(self, point: Pair) -> float:
        """Where `point` (on the line or circle) lies: 0 at the start, 1 at the end."""
        if not self.bulge:
            along_u, along_v = self.tangent(end=False)
            from_u, from_v = point[0] - self.start[0], point[1] - self.start[1]
            return (along_u * from_u + along_v * from_v) / self.length
        centre = self.centre
        first = math.atan2(self.start[1] - centre[1], self.start[0] - centre[0])
        here = math.atan2(point[1] - centre[1], point[0] - centre[0])
        # Measured from the middle of the arc, so that both ends lie well within (-pi, pi].
        middle = math.remainder(here - first - self.angle / 2, math.tau)
        return 0.5 + middle / self.angle


def check(values: Sequence[float]) -> None:
    """Refuse what is no closed path.

    Raises:
        SceneError: Fewer than 2 corners, a number missing, two equal corners in a row, or a path
            that turns back on itself.
    """
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


def pieces(values: Sequence[float]) -> list[Piece]:
    """The lines and arcs between the corners, closed back to the first."""
    corners = [tuple(values[index : index + 3]) for index in range(0, len(values), 3)]
    return [
        Piece(start=(u, v), end=(next_u, next_v), bulge=bulge)
        for (u, v, bulge), (next_u, next_v, _) in zip(
            corners, corners[1:] + corners[:1], strict=True
        )
    ]


def rounded(values: Sequence[float], radius: float) -> list[Piece] | None:
    """The path with an arc of `radius` in every convex corner; None where they do not fit."""
    sharp = pieces(values)
    if radius == 0:
        return sharp
    first, last = [0.0] * len(sharp), [1.0] * len(sharp)
    arcs: list[Piece | None] = []
    for index, after in enumerate(sharp):
        before = sharp[index - 1]
        fillet = None
        if _turn(before, after) > _SMOOTH:
            fillet = _fillet(before, after, radius)
            if fillet is None:
                return None
            last[index - 1] = before.share(fillet.start)
            first[index] = after.share(fillet.end)
        arcs.append(fillet)
    path: list[Piece] = []
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
            path.append(Piece(start, end, bulge))
    return path


def fitted(values: tuple[float, ...], radius: float) -> list[Piece]:
    """The path with an arc of `radius` [m] in every convex corner.

    Raises:
        SceneError: The arcs do not fit.
    """
    path = rounded(values, radius)
    if path is None:
        raise SceneError(
            f"path: corners rounded to {radius!r} m; allowed: up to {radius_max(values):g} m"
        )
    return path


@lru_cache(maxsize=256)
def radius_max(values: tuple[float, ...]) -> float:
    """Largest radius [m] whose arcs fit in every convex corner; inf where none is convex."""
    sharp = pieces(values)
    if all(_turn(sharp[index - 1], sharp[index]) <= _SMOOTH for index in range(len(sharp))):
        return math.inf
    low, high = 0.0, sum(piece.length for piece in sharp)
    while high - low > 1e-9 * high:
        middle = (low + high) / 2
        low, high = (low, middle) if rounded(values, middle) is None else (middle, high)
    return low


def extent(values: tuple[float, ...], radius: float) -> tuple[Pair, Pair]:
    """Least and greatest u, and v, of the rounded path [m]; infinite for material outside of it.

    Raises:
        SceneError: The rounding does not fit.
    """
    points: list[Pair] = []
    area = 0.0
    for piece in fitted(values, radius):
        points.append(piece.start)
        area += (piece.start[0] * piece.end[1] - piece.end[0] * piece.start[1]) / 2
        if piece.bulge:
            (u, v), reach = piece.centre, abs(piece.radius)
            area += reach**2 * (piece.angle - math.sin(piece.angle)) / 2
            poles = [(u + reach, v), (u - reach, v), (u, v + reach), (u, v - reach)]
            points += [pole for pole in poles if 0 <= piece.share(pole) <= 1]
    if area < 0:
        return (-math.inf, math.inf), (-math.inf, math.inf)
    first, second = [point[0] for point in points], [point[1] for point in points]
    return (min(first), max(first)), (min(second), max(second))


def _turn(before: Piece, after: Piece) -> float:
    (u, v), (next_u, next_v) = before.tangent(end=True), after.tangent(end=False)
    return math.atan2(u * next_v - v * next_u, u * next_u + v * next_v)


def _fillet(before: Piece, after: Piece, radius: float) -> Piece | None:
    """The arc of `radius` that touches both pieces inside their corner; None where there is none.

    Its centre lies `radius` inside both: Newton's method, while the radius grows from 0 so that
    the solution next to the corner is followed.
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
    return Piece(start, end, math.tan(angle / 4)) if angle > 0 else None
