"""An indenter: a fold of parts or a body from a file, upright or leaning, and its distance."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.errors import SceneError, check_range
from sim.indenters.outline import EVERYWHERE, Bounds, Part
from sim.indenters.solid import Solid

# The first crossing of a signed distance along upright columns: heights of a lower surface.

Array = NDArray[np.float64]
# Gap and z of its gradient, in the columns of these numbers at these heights.
Distance = Callable[[NDArray[np.int64], Array], tuple[Array, Array]]

# Share of the gap that a march dares: gaps near rounded edges are exact to first order only.
STRIDE = 0.8
# Gaps below this are contact [m].
TOUCHING = 1e-13
# A crossing is found when it moves by less than this [m].
SETTLED = 1e-12


def lower_surface(distance: Distance, count: int, reach: float) -> Array:
    """First height (count,) [m] at which each column, going up from 0, enters the body.

    inf where it stays outside up to `reach`. Each column is marched up by a share of the gap, and
    by 1/2000 of `reach` at least, until it is inside; Newton's method then finds the crossing
    within that bracket, bisecting where Newton leaves it.
    """
    low, high = _bracketed(distance, count, reach)
    return _crossing(distance, low, high)


def _bracketed(distance: Distance, count: int, reach: float) -> tuple[Array, Array]:
    """A height outside the body and one inside it; inf where no height is inside."""
    low, high, height = np.zeros(count), np.full(count, np.inf), np.zeros(count)
    going = np.arange(count)
    while len(going):
        gap, _ = distance(going, height[going])
        inside = gap <= TOUCHING
        high[going[inside]] = height[going[inside]]
        going, gap = going[~inside], gap[~inside]
        low[going] = height[going]
        height[going] += STRIDE * gap + reach / 2000
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
        # A bisection now and then, so that a bracket which Newton narrows from one side closes.
        height[going] = np.where(within & (turn % 4 > 0), newton, (below + above) / 2)
        moved = np.abs(height[going] - here)
        settled = (within & (moved < SETTLED)) | (above - below < SETTLED)
        going = going[~settled]
    return height


# A body that leans: how it is turned, and how far its lowest point then lies below the origin.

Tilt = tuple[float, float]

UPRIGHT: Tilt = (0.0, 0.0)
# Largest angle from upright [rad].
TILT_MAX = math.radians(30)
# How far from its axis the lowest point of a body without sides is looked for [m].
SPAN = 20e-3
# Places along x and y from which it is.
SEEDS = 41
# Steps downwards, in half-widths of the body: far ones, then near ones, where distances are exact.
STRIDES = (0.2, 0.005)
# Steps of each kind, and how often each is taken back along the normal.
STEPS_MAX, RETURNS = 300, 6
# Gain that ends the steps [m]; what counts as on the surface [m].
TILT_SETTLED, ON_SURFACE = 1e-13, 1e-10


def rotation(tilt: Tilt) -> Array:
    """The matrix (3, 3) that turns by the rotation vector (about x, about y, 0) [rad].

    Rodrigues' formula; both angles at once, so that neither comes first.
    """
    angle = math.hypot(*tilt)
    if angle == 0:
        return np.eye(3)
    x, y = tilt[0] / angle, tilt[1] / angle
    across = np.array([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]])
    turn: Array = np.eye(3) + math.sin(angle) * across + (1 - math.cos(angle)) * across @ across
    return turn


def lowest(upright: Indenter, turn: Array) -> float:
    """Least z [m] of an upright body that is turned about the origin, to some nanometres.

    From wherever the body is lowest among its neighbours on a grid, a point slides on over the
    surface: a step straight down, and back along the normal, until that gains nothing.

    Raises:
        SceneError: A body without end, which has no lowest point when it leans.
    """
    x_side, y_side, _ = upright.bounds
    endless = not np.isfinite([x_side, y_side]).all()
    span = SPAN if endless else math.inf
    low, high = np.clip(np.transpose([x_side, y_side]), -span, span)
    half = float(max(np.abs(low).max(), np.abs(high).max()))
    points = _on_surface(upright, _seeds(upright, turn, (low, high), half))[0]
    found = points @ turn[2]
    for stride in STRIDES:
        for _ in range(STEPS_MAX):
            moved, gap = _on_surface(upright, points - stride * half * turn[2])
            below = moved @ turn[2]
            gained = (below < found - TILT_SETTLED) & (np.abs(gap) < ON_SURFACE)
            points[gained], found[gained] = moved[gained], below[gained]
            if not gained.any():
                break
    best = int(np.argmin(found))
    if endless and np.abs(points[best, :2]).max() > 0.9 * SPAN:
        raise SceneError(
            f"indenter {upright.name}.tilt: it has no lowest point when it leans; allowed: upright"
        )
    return float(found[best])


def _seeds(upright: Indenter, turn: Array, box: tuple[Array, Array], half: float) -> Array:
    """Places (N, 3) near the surface where the turned body is low, none of them left out.

    Columns are followed up to where they come as near to the body as to the next column, so that
    no spike stands unseen between them.
    """
    from scipy.ndimage import minimum_filter

    x, y = np.linspace(*box, SEEDS).T
    columns = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    near = math.hypot(x[1] - x[0], y[1] - y[0]) / 2

    def distance(index: NDArray[np.int64], height: Array) -> tuple[Array, Array]:
        gap, normal = upright.distance(np.column_stack([columns[index], height - near]))
        return gap - near, normal[:, 2]

    # What stands higher, even at the far corner, stays above the tip.
    tangent = math.sqrt(1 - turn[2, 2] ** 2) / turn[2, 2]
    reach = 2 * math.sqrt(2) * half * tangent + 2 * near
    places = np.column_stack([columns, lower_surface(distance, len(columns), reach) - near])
    drop = (places @ turn[2]).reshape(SEEDS, SEEDS)
    low = (drop == minimum_filter(drop, 3)) & np.isfinite(drop)
    seeds: Array = places[low.ravel()]
    return seeds


def _on_surface(upright: Indenter, points: Array) -> tuple[Array, Array]:
    """Points (N, 3) taken back to the surface along its normal, and the gap that is left (N,)."""
    gap = np.zeros(len(points))
    for _ in range(RETURNS):
        gap, normal = upright.distance(points)
        points = points - gap[:, None] * normal
    return points, gap


# Least gradient of a rounded edge: below it the faces are so nearly opposite that there is no edge,
# and the nearer face alone counts.
STEEPNESS_MIN = 0.1


@dataclass(frozen=True, slots=True)
class Indenter:
    """A rigid body, tip down: its lowest point is at z = 0, the material is above (z up).

    The parts are joined in turn; every convex edge that an `intersect` or `subtract` makes, and
    every convex corner of a path, is rounded to `edge_radius`. Rounding takes material away beside
    the edge; faces and the tip plane stay where they are. In place of parts there may be a `solid`
    from a file (`from_stl`), all of whose convex edges are rounded.

    Raises:
        SceneError: No part, a first part that is not a `union`, an edge radius that does not fit
            the narrowest part, a lowest point that is not at z = 0, or a tilt out of range.
    """

    name: str
    parts: tuple[Part, ...] = ()
    edge_radius: float = 0.0
    """Radius of every convex edge [m], from 0 (sharp) to half the narrowest width."""
    narrowest: float = math.inf
    """Narrowest wall between two parts [m], such as between a recess and a side; the parts know
    their own widths."""
    solid: Solid | None = None
    """A body from a file, in place of parts."""
    tilt: Tilt = UPRIGHT
    """Rotation vector about x and y [rad] by which the body leans; see `tilted`."""

    def __post_init__(self) -> None:
        owner = f"indenter {self.name}"
        if len(self.tilt) != 2:
            raise SceneError(f"{owner}.tilt: {self.tilt!r}; allowed: angles about x and y [rad]")
        for axis, angle in zip("xy", self.tilt, strict=True):
            check_range(owner, f"tilt about {axis}", angle, -TILT_MAX, TILT_MAX, unit="rad")
        check_range(owner, "tilt", math.hypot(*self.tilt), 0.0, TILT_MAX, unit="rad")
        if self.solid is not None:
            if self.parts:
                raise SceneError(f"{owner}: parts and a solid; allowed: either")
            # How much room there is shows when the file is read, not before.
            check_range(owner, "edge_radius", self.edge_radius, 0.0, self.solid.reach, unit="m")
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

    def tilted(self, about_x: float, about_y: float) -> Indenter:
        """The same body leaning by the rotation vector (about_x, about_y, 0) [rad].

        It turns about the origin, right-handed, and is then raised until its lowest point is at
        z = 0 again; nothing moves aside, so that a small tilt is a small change. The tilt is from
        upright, whatever it was before.

        Raises:
            SceneError: More than 30 degrees in all, or a body without end.
        """
        leaning = replace(self, tilt=(float(about_x), float(about_y)))
        _ = leaning.stance
        return leaning

    @property
    def upright(self) -> Indenter:
        """The same body without its tilt."""
        return self if self.tilt == UPRIGHT else replace(self, tilt=UPRIGHT)

    @property
    def stance(self) -> tuple[Array, float]:
        """The matrix (3, 3) that the upright body is turned by, and how far it is raised [m]."""
        return _stance(self)

    @property
    def edge_radius_max(self) -> float:
        """Largest edge radius that the parts have room for [m]; of a solid it is not known."""
        return min((self.narrowest / 2, *(part.edge_radius_max for part in self.parts)))

    @property
    def sharpest(self) -> float:
        """Smallest radius that the surface may be rounded with [m]; 0 with a sharp edge."""
        if self.solid is not None:
            return self.edge_radius
        radii = [part.values[2] for part in self.parts if part.figure == "circle"]
        if any(part.join != "union" or part.figure == "path" for part in self.parts):
            radii.append(self.edge_radius)
        return float(min(radii, default=math.inf))

    @property
    def bounds(self) -> Bounds:
        """A box around the body: least and greatest x, y and z [m]; infinite where it is open."""
        return self.bounds_below(math.inf)

    def bounds_below(self, height: float) -> Bounds:
        """A box around what of the body is below `height` [m], or a larger one."""
        x, y, z = self._upright_bounds()
        if self.tilt == UPRIGHT:
            return x, y, (z[0], min(z[1], height))
        (to_x, to_y, to_z), raised = self.stance
        if not np.isfinite([x, y]).all():
            return EVERYWHERE, EVERYWHERE, (0.0, height)
        # The highest that a point of the upright body can be to end up below `height`.
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
        """Gap and outward unit normal at points (..., 3) [m] in the indenter's frame.

        Returns:
            Gap (...,) [m], below 0 inside; normal (..., 3), the unit gradient of the gap. The
            surface is exact; away from it the gap is exact for single parts and edges at the angle
            of `Part.cosine`, elsewhere to first order. Of a solid all is as exact as its grid.
        """
        given = np.asarray(points, np.float64)
        gap, normal = self._distance(given.reshape(-1, 3))
        return gap.reshape(given.shape[:-1]), normal.reshape(given.shape)

    def _distance(self, points: Array) -> tuple[Array, Array]:
        """`distance` at points (N, 3)."""
        if self.tilt == UPRIGHT:
            return self._upright_distance(points)
        turn, raised = self.stance
        gap, normal = self._upright_distance((points - [0.0, 0.0, raised]) @ turn)
        return gap, normal @ turn.T

    def _upright_distance(self, points: Array) -> tuple[Array, Array]:
        if self.solid is not None:
            return self.solid.distances(self.edge_radius).distance(points)
        return self._joined([part.distance(points, self.edge_radius) for part in self.parts])

    def heights(self, x: ArrayLike, y: ArrayLike, *, reach: float = 10e-3) -> Array:
        """Height of the lower surface above the tip plane at x, y (broadcast together) [m].

        inf where there is no surface below `reach` [m]. Exact to 1e-9 m; a slit of material less
        than 1/2000 of `reach` high may be missed.
        """
        plan = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        columns = np.stack([axis.ravel() for axis in plan], axis=1)
        low, high = np.transpose(self.bounds_below(reach)[:2])
        inside = np.flatnonzero(((columns >= low) & (columns <= high)).all(axis=1))
        heights = np.full(len(columns), np.inf)
        heights[inside] = self._column_heights(columns[inside], reach)
        return heights.reshape(plan[0].shape)

    def _column_heights(self, columns: Array, reach: float) -> Array:
        """`heights` of columns (N, 2); what does not change along z is computed once."""
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

        return lower_surface(distance, len(columns), reach)

    def _joined(self, alone: list[tuple[Array, Array]]) -> tuple[Array, Array]:
        """Gap (N,) and normal (N, 3) of the whole, from those of each part alone."""
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
    """Gap and normal of what two bodies share, the edge between them rounded to `radius`.

    Let a and b be the distances from the faces shifted inwards by the radius, and c the cosine
    between their normals. Where the edge of the shifted faces is the nearest,

        d^2 = (a^2 + b^2 - 2 c a b) / (1 - c^2)

    is the distance from it (the law of cosines), and d - radius the gap: an arc, tangent to both
    faces. Where the true cosine differs from c the gradient of d is not of length 1: the gap is
    divided by that length, which keeps the surface and makes the gap right to first order.
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
