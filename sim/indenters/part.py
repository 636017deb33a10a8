"""One part of an indenter: a flat figure, drawn in plan, drawn in side view, or turned."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from sim.checks import check_range
from sim.errors import SceneError
from sim.indenters import outline, outline_distance

Array = NDArray[np.float64]
Interval = tuple[float, float]
Bounds = tuple[Interval, Interval, Interval]
"""Least and greatest x, y and z [m]; infinite where there is no end."""

View = Literal["plan", "side", "turned"]
Figure = Literal["half_plane", "band", "circle", "path"]
Join = Literal["union", "intersect", "subtract"]
VIEWS: tuple[View, ...] = get_args(View)
FIGURES: tuple[Figure, ...] = get_args(Figure)
JOINS: tuple[Join, ...] = get_args(Join)

LENGTHS = {"half_plane": 3, "band": 4, "circle": 3}


@dataclass(frozen=True, slots=True)
class Part:
    """A figure in the plane (u, v), swept through space, and how it joins the parts before it.

    The view says what u and v are: `plan` is (x, y), straight along z; `side` is (x, z), straight
    along y; `turned` is (distance from `axis`, z), a body of revolution. The distance to a figure
    is then the distance to the swept body, exactly.

    Raises:
        SceneError: An unknown name, or values that draw no figure.
    """

    view: View
    figure: Figure
    values: tuple[float, ...]
    """`half_plane`: outward unit normal (2), offset: the material is where normal . (u, v) <=
    offset. `band`: unit normal (2), offset of the middle, half the width. `circle`: centre (2),
    radius. `path`: corners (u, v, bulge) in turn, the material on the left, bulge = tan(angle / 4)
    of the arc to the next corner: 0 is straight, above 0 turns left. Lengths in [m]."""
    join: Join = "intersect"
    """`union` adds, `intersect` keeps what both have, `subtract` takes away; the edges that the
    last two make are rounded."""
    axis: tuple[float, float] = (0.0, 0.0)
    """Where the axis of a `turned` part stands in x and y [m]."""
    cosine: float = 0.0
    """Cosine between this part's outward normal and the others' along the edge they make: 0 for a
    right angle. The rounding of plane and conical faces is a true arc only when it is right."""

    def __post_init__(self) -> None:
        for name, word, allowed in (
            ("view", self.view, VIEWS),
            ("figure", self.figure, FIGURES),
            ("join", self.join, JOINS),
        ):
            if word not in allowed:
                raise SceneError(f"part.{name}: {word!r}; allowed: {', '.join(allowed)}")
        if not all(math.isfinite(value) for value in self.values):
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
            outline.check(self.values)
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
        """Signed distance to the part alone and its gradient, at points (N, 3): (N,), (N, 3).

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
            return outline_distance.distance(outline_distance.rows(self.values, radius), u, v)
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
        """Largest radius [m] to which the part's own edges can be rounded; inf without a limit."""
        if self.join == "subtract":
            return math.inf
        if self.figure in ("band", "circle"):
            return self.values[-1]
        if self.figure == "path":
            return outline.radius_max(self.values)
        normal_u, _, offset = self.values
        if self.view == "turned" and normal_u > 0:
            # The fillet of two straight faces reaches radius * sqrt((1 - c) / (1 + c)) in from
            # their edge; it may reach the axis, not beyond.
            return max(0.0, offset / normal_u) * math.sqrt((1 + self.cosine) / (1 - self.cosine))
        return math.inf

    def bounds(self, radius: float) -> Bounds:
        """Where the part alone reaches in x, y and z [m], its own corners rounded to `radius`."""
        along_u, along_v = self._extent(radius)
        if self.view == "plan":
            return along_u, along_v, EVERYWHERE
        if self.view == "side":
            return along_u, EVERYWHERE, along_v
        (x, y), reach = self.axis, along_u[1]
        return (x - reach, x + reach), (y - reach, y + reach), along_v

    def _extent(self, radius: float) -> tuple[Interval, Interval]:
        if self.figure == "path":
            return outline.extent(self.values, radius)
        if self.figure == "circle":
            u, v, round_radius = self.values
            return (u - round_radius, u + round_radius), (v - round_radius, v + round_radius)
        normal_u, normal_v, offset = self.values[:3]
        low = offset - self.values[3] if self.figure == "band" else -math.inf
        high = offset + self.values[3] if self.figure == "band" else offset
        return _between(normal_u, low, high), _between(normal_v, low, high)


EVERYWHERE: Interval = (-math.inf, math.inf)


def _between(normal: float, low: float, high: float) -> Interval:
    """Where a coordinate lies when `low` <= normal * coordinate <= `high`: only for +-1 bounded."""
    if normal == 1:
        return low, high
    return (-high, -low) if normal == -1 else EVERYWHERE
