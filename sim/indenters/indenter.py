"""Rigid indenter made of joined parts or of a file, upright or tilted, and its signed distance."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.arrays import Array
from sim.errors import SceneError, check_range, make_plain
from sim.indenters.outline import EVERYWHERE, Bounds, Part
from sim.indenters.solid import Solid

# Heights of a lower surface: the first zero of a signed distance along upright columns.

# Function from columns (by index) and heights to the gap and the z component of its gradient.
Distance = Callable[[NDArray[np.int64], Array], tuple[Array, Array]]

# Fraction of the gap per marching step, since gaps near rounded edges are exact to first order.
STRIDE = 0.8
# Gaps below this are contact [m].
TOUCHING = 1e-13
# Convergence tolerance of a crossing [m].
SETTLED = 1e-12


# Thinnest material that is surely found, over the height that is searched.
THINNEST = 1 / 2000


def lower_surface(
    distance: Distance, count: int, reach: float, thinnest: float = THINNEST
) -> Array:
    """Return the first height (count,) [m] at which each column, going up from 0, enters the body.

    It is inf if the column stays outside up to `reach`. Each column is marched upwards by a
    fraction of the gap plus `thinnest` of `reach`, until it is inside. Newton's method then finds
    the crossing within that bracket, with bisection where a Newton step leaves it.
    """
    low, high = _bracketed(distance, count, reach, thinnest * reach)
    return _crossing(distance, low, high)


def _bracketed(distance: Distance, count: int, reach: float, least: float) -> tuple[Array, Array]:
    """Return a height outside the body and one inside it; inf if no height is inside."""
    low, high, height = np.zeros(count), np.full(count, np.inf), np.zeros(count)
    going = np.arange(count)
    while len(going):
        gap, _ = distance(going, height[going])
        inside = gap <= TOUCHING
        high[going[inside]] = height[going[inside]]
        going, gap = going[~inside], gap[~inside]
        low[going] = height[going]
        height[going] += STRIDE * gap + least
        going = going[height[going] <= reach]
    return low, high


def _crossing(distance: Distance, low: Array, high: Array) -> Array:
    height = np.where(high > low, (low + high) / 2, high)
    going = np.flatnonzero((high > low) & np.isfinite(high))
    turn = 0
    while len(going):
        here = height[going]
        gap, slope = distance(going, here)
        outside = gap > 0
        low[going[outside]], high[going[~outside]] = here[outside], here[~outside]
        below, above = low[going], high[going]
        falling = slope < 0
        newton = here - gap / np.where(falling, slope, 1.0)
        within = falling & (newton >= below) & (newton <= above)
        turn += 1
        # Every fourth step bisects, so that a bracket that Newton narrows from one side closes.
        height[going] = np.where(within & (turn % 4 > 0), newton, (below + above) / 2)
        moved = np.abs(height[going] - here)
        settled = (within & (moved < SETTLED)) | (above - below < SETTLED)
        going = going[~settled]
    return height


# Tilted bodies: their rotation, and the height of their lowest point.

Tilt = tuple[float, float]

UPRIGHT: Tilt = (0.0, 0.0)
# Largest angle from upright [rad].
TILT_MAX = math.radians(30)
# Range around the axis in which the lowest point of an unbounded body is searched [m].
SPAN = 20e-3
# Number of starting points along x and y.
SEEDS = 41
# Step sizes downwards, in half-widths of the body: large, then small, where distances are exact.
STRIDES = (0.2, 0.005)
# Most steps of each size, and projections along the normal after each step.
STEPS_MAX, RETURNS = 300, 6
# Least gain per step [m], and largest gap of a point on the surface [m].
TILT_SETTLED, ON_SURFACE = 1e-13, 1e-10


def rotation(tilt: Tilt) -> Array:
    """Return the matrix (3, 3) of the rotation vector (about x, about y, 0) [rad] (Rodrigues)."""
    angle = math.hypot(*tilt)
    if angle == 0:
        return np.eye(3)
    x, y = tilt[0] / angle, tilt[1] / angle
    across = np.array([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]])
    turn: Array = np.eye(3) + math.sin(angle) * across + (1 - math.cos(angle)) * across @ across
    return turn


def lowest(upright: Indenter, turn: Array) -> float:
    """Return the least z [m] of an upright body rotated about the origin, to some nanometres.

    From each local minimum on a grid, a point slides over the surface by steps straight down and
    back along the normal, until a step gains nothing.
    """
    x_side, y_side, _ = upright.bounds
    endless = not np.isfinite([x_side, y_side]).all()
    span = SPAN if endless else math.inf
    low, high = np.clip(np.transpose([x_side, y_side]), -span, span)
    half = float(max(np.abs(low).max(), np.abs(high).max()))
    points = _on_surface(upright, _seeds(upright, turn, (low, high), half))[0]
    height = points @ turn[2]
    for stride in STRIDES:
        for _ in range(STEPS_MAX):
            moved, gap = _on_surface(upright, points - stride * half * turn[2])
            below = moved @ turn[2]
            gained = (below < height - TILT_SETTLED) & (np.abs(gap) < ON_SURFACE)
            points[gained], height[gained] = moved[gained], below[gained]
            if not gained.any():
                break
    best = int(np.argmin(height))
    if endless and np.abs(points[best, :2]).max() > 0.9 * SPAN:
        raise SceneError(
            f"indenter {upright.name}.tilt: it has no lowest point when it leans; allowed: upright"
        )
    return float(height[best])


def _seeds(upright: Indenter, turn: Array, box: tuple[Array, Array], half: float) -> Array:
    """Return points (N, 3) near all local minima of the rotated body's surface.

    Columns are followed up until they are as near to the body as to the next column, so that no
    spike between columns is missed.
    """
    from scipy.ndimage import minimum_filter

    x, y = np.linspace(*box, SEEDS).T
    columns = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    near = math.hypot(x[1] - x[0], y[1] - y[0]) / 2

    def distance(index: NDArray[np.int64], height: Array) -> tuple[Array, Array]:
        gap, normal = upright.distance(np.column_stack([columns[index], height - near]))
        return gap - near, normal[:, 2]

    # Points that are higher stay above the tip after rotation, even at the far corner.
    tangent = math.sqrt(1 - turn[2, 2] ** 2) / turn[2, 2]
    reach = 2 * math.sqrt(2) * half * tangent + 2 * near
    points = np.column_stack([columns, lower_surface(distance, len(columns), reach) - near])
    drop = (points @ turn[2]).reshape(SEEDS, SEEDS)
    low = (drop == minimum_filter(drop, 3)) & np.isfinite(drop)
    return np.asarray(points[low.ravel()])


def _on_surface(upright: Indenter, points: Array) -> tuple[Array, Array]:
    """Return points (N, 3) projected onto the surface along its normal, and the last gap (N,)."""
    gap = np.zeros(len(points))
    for _ in range(RETURNS):
        gap, normal = upright.distance(points)
        points = points - gap[:, None] * normal
    return points, gap


# Least gradient of a rounded edge. Below it the faces are nearly opposite and form no edge, so that
# only the nearer face counts.
STEEPNESS_MIN = 0.1


@dataclass(frozen=True, slots=True)
class Indenter:
    """Rigid body, tip down: its lowest point is at z = 0, the material is above (z up).

    The parts are joined in order. Every convex edge from an `intersect` or `subtract`, and every
    convex corner of a path, is rounded to `edge_radius`. Rounding removes material near the edge;
    faces and the tip plane do not move. In place of parts there may be a `solid` from a file
    (`from_stl`), all of whose convex edges are rounded.

    Raises:
        SceneError: There is no part, the first part is not a `union`, the edge radius does not fit
            the narrowest part, the lowest point is not at z = 0, or the tilt is out of range.
    """

    name: str
    parts: tuple[Part, ...] = ()
    edge_radius: float = 0.0
    """Radius of every convex edge [m], from 0 (sharp) to half the narrowest width."""
    narrowest: float = math.inf
    """Narrowest wall between two parts [m], such as between a recess and a side; widths of single
    parts are known."""
    solid: Solid | None = None
    """Body from a file, in place of parts."""
    tilt: Tilt = UPRIGHT
    """Rotation vector about x and y [rad] of the body's tilt; see `tilted`."""
    sharpest: float = field(init=False, repr=False, compare=False)
    """Lower bound of the surface's radius of curvature [m]; 0 with a sharp edge. It follows from
    the parts and the edge radius."""

    def __post_init__(self) -> None:
        make_plain(self)
        owner = f"indenter {self.name}"
        if len(self.tilt) != 2:
            raise SceneError(f"{owner}.tilt: {self.tilt!r}; allowed: angles about x and y [rad]")
        for axis, angle in zip("xy", self.tilt, strict=True):
            check_range(owner, f"tilt about {axis}", angle, -TILT_MAX, TILT_MAX, unit="rad")
        check_range(owner, "tilt", math.hypot(*self.tilt), 0.0, TILT_MAX, unit="rad")
        if self.solid is not None:
            if self.parts:
                raise SceneError(f"{owner}: parts and a solid; allowed: either")
            # The largest radius that fits is known only after the file is read.
            check_range(owner, "edge_radius", self.edge_radius, 0.0, self.solid.reach, unit="m")
            object.__setattr__(self, "sharpest", max(self.edge_radius, self.solid.sharpest))
            return
        if not self.parts:
            raise SceneError(f"{owner}: no parts; allowed: 1 or more")
        if self.parts[0].join != "union":
            raise SceneError(
                f"{owner}.parts[0].join: {self.parts[0].join!r}; allowed: 'union', there is "
                "nothing before it"
            )
        if not self.narrowest > 0:
            raise SceneError(f"{owner}.narrowest: {self.narrowest!r} m; allowed: above 0, or inf")
        limit = self.edge_radius_max * (1 + 1e-9)  # 0.4 mm fits a wall of 3.5 - 2.7 mm
        check_range(owner, "edge_radius", self.edge_radius, 0.0, limit, unit="m")
        tip = self._upright_bounds()[2][0]
        if math.isfinite(tip) and abs(tip) > 1e-9:
            raise SceneError(
                f"{owner}: the rounded body's lowest point is at z = {tip:g} m; allowed: 0 (draw a "
                "round tip as an arc)"
            )
        radii = [part.values[2] for part in self.parts if part.figure == "circle"]
        if any(part.join != "union" or part.figure == "path" for part in self.parts):
            radii.append(self.edge_radius)
        object.__setattr__(self, "sharpest", float(min(radii, default=math.inf)))

    def tilted(self, about_x: float, about_y: float) -> Indenter:
        """Return the body tilted by the rotation vector (about_x, about_y, 0) [rad].

        It rotates about the origin, right-handed, and is then raised until its lowest point is at
        z = 0 again. It does not move sideways, so that a small tilt is a small change. The tilt is
        relative to upright and replaces any previous one.

        Raises:
            SceneError: The tilt is more than 30 degrees in total, or the body is unbounded.
        """
        leaning = replace(self, tilt=(about_x, about_y))
        _ = leaning.stance
        return leaning

    @property
    def upright(self) -> Indenter:
        """Body without its tilt."""
        return self if self.tilt == UPRIGHT else replace(self, tilt=UPRIGHT)

    @property
    def stance(self) -> tuple[Array, float]:
        """Rotation matrix (3, 3) of the upright body, and the height by which it is raised [m]."""
        return _stance(self)

    @property
    def edge_radius_max(self) -> float:
        """Largest edge radius that fits the parts [m]; unknown for a solid."""
        return min((self.narrowest / 2, *(part.edge_radius_max for part in self.parts)))

    @property
    def bounds(self) -> Bounds:
        """Bounding box of the body: least and greatest x, y, z [m]; infinite if unbounded."""
        return self.bounds_below(math.inf)

    def bounds_below(self, height: float) -> Bounds:
        """Return a box that contains the part of the body below `height` [m]."""
        x, y, z = self._upright_bounds()
        if self.tilt == UPRIGHT:
            return x, y, (z[0], min(z[1], height))
        (to_x, to_y, to_z), raised = self.stance
        if not np.isfinite([x, y]).all():
            return EVERYWHERE, EVERYWHERE, (0.0, height)
        # Upper bound of the height in the upright body of points that end up below `height`.
        aside = abs(to_z[0]) * max(map(abs, x)) + abs(to_z[1]) * max(map(abs, y))
        top = min(z[1], (height - raised + aside) / to_z[2])
        if not math.isfinite(top):
            return EVERYWHERE, EVERYWHERE, (0.0, height)
        corners = np.stack(np.meshgrid(x, y, (z[0], max(z[0], top))), axis=-1).reshape(-1, 3)
        along_x, along_y = corners @ to_x, corners @ to_y
        highest = float((corners @ to_z).max()) + raised
        return (
            (float(along_x.min()), float(along_x.max())),
            (float(along_y.min()), float(along_y.max())),
            (0.0, min(height, highest)),
        )

    def _upright_bounds(self) -> Bounds:
        if self.solid is not None:
            return self.solid.distances(self.edge_radius).bounds
        box = self.parts[0].bounds(self.edge_radius)
        for part in self.parts[1:]:
            other = part.bounds(self.edge_radius)
            if part.join == "union":
                box = _sides(box, other, min, max)
            elif part.join == "intersect":
                box = _sides(box, other, max, min)
        return box

    def distance(self, points: ArrayLike) -> tuple[Array, Array]:
        """Return gap and outward unit normal at points (..., 3) [m] in the indenter's frame.

        Returns:
            Gap (...,) [m], below 0 inside; normal (..., 3), the unit gradient of the gap. The
            surface is exact. Away from it, the gap is exact for single parts and edges at the angle
            of `Part.cosine`, else to first order. For a solid, accuracy is that of its grid.
        """
        positions = np.asarray(points, np.float64)
        gap, normal = self._distance(positions.reshape(-1, 3))
        return gap.reshape(positions.shape[:-1]), normal.reshape(positions.shape)

    def _distance(self, points: Array) -> tuple[Array, Array]:
        """Return `distance` at points (N, 3)."""
        if self.tilt == UPRIGHT:
            return self._upright_distance(points)
        turn, raised = self.stance
        gap, normal = self._upright_distance((points - [0.0, 0.0, raised]) @ turn)
        return gap, normal @ turn.T

    def _upright_distance(self, points: Array) -> tuple[Array, Array]:
        if self.solid is not None:
            return self.solid.distances(self.edge_radius).distance(points)
        return self._joined([part.distance(points, self.edge_radius) for part in self.parts])

    def heights(
        self, x: ArrayLike, y: ArrayLike, *, reach: float = 10e-3, thinnest: float = THINNEST
    ) -> Array:
        """Return the lower surface's height above the tip plane at x, y (broadcast together) [m].

        It is inf if there is no surface below `reach` [m]. It is exact to 1e-9 m; material thinner
        than `thinnest` of `reach` may be missed.
        """
        plan = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        columns = np.stack([axis.ravel() for axis in plan], axis=1)
        low, high = np.transpose(self.bounds_below(reach)[:2])
        inside = np.flatnonzero(((columns >= low) & (columns <= high)).all(axis=1))
        heights = np.full(len(columns), np.inf)
        heights[inside] = self._column_heights(columns[inside], reach, thinnest)
        return heights.reshape(plan[0].shape)

    def _column_heights(self, columns: Array, reach: float, thinnest: float) -> Array:
        """Return `heights` of columns (N, 2); upright parts are evaluated once per column."""
        ground = np.column_stack([columns, np.zeros(len(columns))])
        upright = {
            part: part.distance(ground, self.edge_radius)
            for part in self.parts
            if part.view == "plan" and self.tilt == UPRIGHT
        }

        def distance(index: NDArray[np.int64], height: Array) -> tuple[Array, Array]:
            points = np.column_stack([columns[index], height])
            if not upright:
                gap, normal = self._distance(points)
                return gap, normal[:, 2]
            alone = [
                (upright[part][0][index], upright[part][1][index])
                if part in upright
                else part.distance(points, self.edge_radius)
                for part in self.parts
            ]
            gap, normal = self._joined(alone)
            return gap, normal[:, 2]

        return lower_surface(distance, len(columns), reach, thinnest)

    def _joined(self, alone: list[tuple[Array, Array]]) -> tuple[Array, Array]:
        """Return gap (N,) and normal (N, 3) of the whole body from those of each part."""
        gap, normal = alone[0]
        for part, (other, other_normal) in zip(self.parts[1:], alone[1:], strict=True):
            if part.join == "union":
                nearer = other < gap
                gap = np.where(nearer, other, gap)
                normal = np.where(nearer[:, None], other_normal, normal)
                continue
            if part.join == "subtract":
                other, other_normal = -other, -other_normal
            gap, normal = _intersection(
                gap, normal, other, other_normal, self.edge_radius, part.cosine
            )
        return gap, normal


@lru_cache(maxsize=4096)
def _stance(indenter: Indenter) -> tuple[Array, float]:
    turn = rotation(indenter.tilt)
    turn.flags.writeable = False
    return turn, 0.0 if indenter.tilt == UPRIGHT else -lowest(indenter.upright, turn)


def _sides(
    box: Bounds, other: Bounds, low: Callable[..., float], high: Callable[..., float]
) -> Bounds:
    x, y, z = (
        (low(mine[0], its[0]), high(mine[1], its[1])) for mine, its in zip(box, other, strict=True)
    )
    return x, y, z


def _intersection(
    gap: Array, normal: Array, other: Array, other_normal: Array, radius: float, cosine: float
) -> tuple[Array, Array]:
    """Return gap and normal of the intersection of two bodies, with its edge rounded to `radius`.

    Let a and b be the distances from the faces shifted inwards by the radius, and c the cosine
    between their normals. Where the edge of the shifted faces is nearest,

        d^2 = (a^2 + b^2 - 2 c a b) / (1 - c^2)

    is the distance from it (the law of cosines), and d - radius the gap: an arc, tangent to both
    faces. If the true cosine differs from c, the gradient of d is not of length 1. The gap is then
    divided by that length, which keeps the surface and makes the gap correct to first order.
    """
    a, b = gap + radius, other + radius
    along_a, along_b = a - cosine * b, b - cosine * a
    sine2 = 1 - cosine * cosine
    length = np.sqrt(np.maximum(a * along_a + b * along_b, 0) / sine2)
    edge = (along_a > 0) & (along_b > 0) & (length > 0)
    scale = sine2 * np.where(edge, length, 1.0)
    gradient = (along_a / scale)[:, None] * normal + (along_b / scale)[:, None] * other_normal
    steepness = np.sqrt(np.einsum("ij,ij->i", gradient, gradient))
    edge &= steepness > STEEPNESS_MIN
    steepness = np.where(edge, steepness, 1.0)
    nearer = other > gap
    face, face_normal = (
        np.where(nearer, other, gap),
        np.where(nearer[:, None], other_normal, normal),
    )
    return (
        np.where(edge, (length - radius) / steepness, face),
        np.where(edge[:, None], gradient / steepness[:, None], face_normal),
    )
