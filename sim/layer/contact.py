"""Contact of a layer: pressure is never tensile, shear never exceeds Coulomb's limit."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from sim.indenters import Indenter
from sim.layer.spectral import Elastic, PixelGrid
from sim.scene import Body, Motion

# Projected gradient descent: the minimum of a quadratic energy within simple bounds.

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True, slots=True)
class Problem:
    """Minimisation of 1/2 x.A x + b.x for x within bounds."""

    apply: Callable[[Array], Array]
    """A x; A is symmetric and positive."""
    project: Callable[[Array], Array]
    """Nearest point within the bounds."""
    local: float
    """Typical element of A's diagonal."""
    scale: float | None = None
    """Norm by which residuals are divided; None: the norm of x."""

    def residual(self, x: Array, slope: Array) -> float:
        """Return |x - project(x - slope / local)| over the scale: 0 only at the solution, <= 1."""
        distance = float(np.linalg.norm(x - self.project(x - slope / self.local)))
        scale = float(np.linalg.norm(x)) if self.scale is None else self.scale
        return distance / max(scale, distance) if distance > 0 else 0.0


@dataclass(frozen=True, slots=True)
class Descent:
    """Result of a descent."""

    x: Array
    slope: Array
    """A x + b at the result."""
    residual: float
    iterations: int


def descend(
    problem: Problem, x: Array, slope: Array, *, tolerance: float, iterations: int
) -> Descent:
    """Minimise from `x` (within the bounds, with its slope) to a residual of `tolerance`.

    Ends earlier after `iterations`. Step lengths are Barzilai and Borwein's (IMA J. Numer. Anal. 8
    (1988) 141), alternately long and short. The energy falls in each iteration, because a move ends
    at its minimum along the way (Birgin, Martinez & Raydan, SIAM J. Optim. 10 (2000) 1196, with the
    exact line search that a quadratic allows). Each iteration takes one product with A.
    """
    step, done = 1 / problem.local, 0
    residual = problem.residual(x, slope)
    while residual > tolerance and done < iterations:
        done += 1
        move = problem.project(x - step * slope) - x
        answer = problem.apply(move)
        curvature, size = float(np.vdot(move, answer)), float(np.vdot(answer, answer))
        if not (curvature > 0 and size > 0):
            break  # the limit of the precision: squares underflow before residuals do
        fraction = min(1.0, -float(np.vdot(slope, move)) / curvature)
        x = x + fraction * move
        slope = slope + fraction * answer
        step = float(np.vdot(move, move)) / curvature if done % 2 else curvature / size
        residual = problem.residual(x, slope)
    return Descent(x, slope, residual, done)


# Most iterations of one descent; 10 are usual, 30 without a guess.
ITERATIONS = 300
# Most turns between normal and tangential contact; 2 to 4 are usual.
TURNS = 200
# Target of a descent over its initial residual: the other descent will move its goal again.
SHARE = 0.1
# A turn that leaves more than this fraction of the residual has overshot.
STALLED = 0.8
# Factor on the fraction of the new shear that is applied, after each such turn; and the least
# fraction.
DAMPED, DAMPED_MOST = 0.6, 0.05
# Avoids 0 / 0 where there is no pressure [Pa].
TINY = 1e-30


@dataclass(frozen=True, slots=True)
class Contact:
    """Traction within a window of X by Y pixels, and its accuracy."""

    traction: Array
    """Traction on the body (3, X, Y) [Pa]; the normal component is never above 0."""
    residual: float
    """Natural residual of the pressure over its norm, or of the shear over the norm of Coulomb's
    limit: the larger one."""
    iterations: int
    """Iterations of all descents."""


def solve_frictionless(body: Elastic, gap: Array, start: Array, *, tolerance: float) -> Contact:
    """Return the pressure that leaves no overlap, to a residual of `tolerance`.

    `gap` (X, Y) [m] is the gap without traction, `start` a guess of the traction (3, X, Y). At
    every pixel pressure >= 0, gap >= 0, and one of them is 0.
    """
    if gap.min() >= 0:
        return Contact(np.zeros_like(start), 0.0, 0)
    pressure = _pushing(-start[2])
    solution = descend(
        Problem(body.answer.normal, _pushing, body.local_normal),
        pressure,
        gap + body.answer.normal(pressure),
        tolerance=tolerance,
        iterations=ITERATIONS,
    )
    traction = np.stack([np.zeros_like(gap), np.zeros_like(gap), -solution.x])
    return Contact(traction, solution.residual, solution.iterations)


def solve_frictional(
    body: Elastic, gap: Array, slip: Array, coefficient: float, start: Array, *, tolerance: float
) -> Contact:
    """Return the pressure and shear that obey Coulomb's law, to a residual of `tolerance`.

    `slip` (2, X, Y) [m] is the sliding of the body over the indenter in this step, like `gap`
    without any traction. In addition to the conditions without friction, |shear| <= coefficient *
    pressure, and where the body slips the shear opposes it and equals that limit. Normal and
    tangential contact are each the minimum of an energy; they are solved in turns, each with the
    other's latest solution (Panagiotopoulos, Ingenieur-Archiv 44 (1975) 421), until both hold. With
    high friction on a material that couples them strongly the turns overshoot and are damped.
    """
    if gap.min() >= 0:
        return Contact(np.zeros_like(start), 0.0, 0)
    answer = body.answer
    pressure = _pushing(-start[2])
    shear = _within(start[:2], coefficient * pressure)
    caused = answer.full(np.concatenate([shear, -pressure[None]]))
    gap, slip = gap - caused[2], slip + caused[:2]
    normal = Problem(answer.normal, _pushing, body.local_normal)
    iterations, fraction, before = 0, 1.0, np.inf
    for _ in range(TURNS):
        tangential = _tangential(body, coefficient * pressure)
        residuals = normal.residual(pressure, gap), tangential.residual(shear, slip)
        residual = max(residuals)
        if residual <= tolerance:
            break
        if residual > STALLED * before:
            fraction = max(DAMPED * fraction, DAMPED_MOST)
        before = residual
        goals = [max(SHARE * each, tolerance / 2) for each in residuals]
        pushed = descend(normal, pressure, gap, tolerance=goals[0], iterations=ITERATIONS)
        slip = slip + answer.shear_by_normal(pressure - pushed.x)
        pressure, gap = pushed.x, pushed.slope
        tangential = _tangential(body, coefficient * pressure)
        allowed = tangential.project(shear)
        slip = slip + answer.shear(allowed - shear)
        rubbed = descend(tangential, allowed, slip, tolerance=goals[1], iterations=ITERATIONS)
        rubbing = allowed + fraction * (rubbed.x - allowed)
        slip = slip + fraction * (rubbed.slope - slip)
        gap = gap - answer.normal_by_shear(rubbing - shear)
        shear = rubbing
        iterations += pushed.iterations + rubbed.iterations
    return Contact(np.concatenate([shear, -pressure[None]]), residual, iterations)


def _tangential(body: Elastic, bound: Array) -> Problem:
    return Problem(
        body.answer.shear,
        lambda shear: _within(shear, bound),
        body.local_shear,
        float(np.linalg.norm(bound)),
    )


def _pushing(pressure: Array) -> Array:
    return np.maximum(pressure, 0.0)


def _within(shear: Array, bound: Array) -> Array:
    length = np.sqrt(shear[0] ** 2 + shear[1] ** 2)
    return np.asarray(shear * (bound / np.maximum(np.maximum(length, bound), TINY)))


# Gap between the undeformed body and the indenter, for any position of its tip.

# Samples of the indenter's lower surface per width of a pixel.
FINENESS = 2
# Distance of the samples by which the covered part of a pixel is known [m]; 12 per pixel at most.
FINE, FINEST = 25e-6, 12
# Steepest side that is no wall, as rise over run: the skin does not follow walls.
WALL = 8.0
# Least covered part of a pixel that can touch, and the least that counts as all of it.
COVERED_LEAST, COVERED_MOST = 0.1, 0.999
# How much more a partly covered pixel yields, over the displacement by its own traction times the
# uncovered part over the covered one. With it, forces of four flat tips 1 mm deep on 48, 64 and 96
# pixels are those on 256 within 2, 1.5 and 1 %; those of a narrow one without it 12, 6 and 3 %.
YIELDING = 0.7
# Heights are searched up to a multiple of this [m], so that similar presses have the same samples.
REACH = 2e-3
# Thinnest material that is sampled, over the height that is searched.
THIN = 1 / 200


@lru_cache(maxsize=64)
def _samples(
    indenter: Indenter,
    origin: tuple[float, float],
    step: tuple[float, float],
    span: float,
    reach: float,
) -> tuple[tuple[int, int], Array]:
    """Return the heights of an indenter within `span` of its axis [m]; cached.

    They are at even places, origin + (first + k) * step along x and y: the first along both, and
    the heights (n, m) [m], inf where there is nothing to touch.
    """
    first, axes = [], []
    for start, width, (low, high) in zip(
        origin, step, indenter.bounds_below(reach)[:2], strict=True
    ):
        low, high = max(low, -span), min(high, span)
        index = np.arange(
            math.floor((low - start) / width) - 1, math.ceil((high - start) / width) + 2
        )
        first.append(int(index[0]))
        axes.append(start + index * width)
    heights = indenter.heights(axes[0][:, None], axes[1], reach=reach, thinnest=THIN)
    return (first[0], first[1]), heights


def endless(indenter: Indenter) -> bool:
    """Return True if the indenter has no sides."""
    return not np.isfinite(indenter.bounds[:2]).all()


def clearance_cap(motion: Motion, body: Body, surface: Array) -> float:
    """Return the height above the tip [m] beyond which nothing touches, for a top at `surface`."""
    return 2 * (motion.depth_max - float(surface.min())) + body.thickness / 2


class Rims:
    """Part of each pixel that an indenter covers, and its mean height there.

    Sums of samples over rectangles are differences of cumulative sums, interpolated, so that both
    change evenly while the indenter slides over the pixels.
    """

    def __init__(self, indenter: Indenter, grid: PixelGrid, span: float, reach: float) -> None:
        count = [min(FINEST, math.ceil(pixel / FINE)) for pixel in grid.pixel]
        self._step = grid.pixel[0] / count[0], grid.pixel[1] / count[1]
        # Samples lie symmetrically about the indenter's middle.
        (west, east), (south, north), _ = indenter.bounds_below(reach)
        origin = (west + east) / 2, (south + north) / 2
        begins, heights = _samples(indenter, origin, self._step, span, reach)
        lowest = minimum_filter(heights, [many // 2 * 2 + 1 for many in count], mode="nearest")
        with np.errstate(invalid="ignore"):
            covered = np.isfinite(heights) & (heights - lowest < WALL / 2 * max(grid.pixel))
        self._first = np.array(origin) + (np.array(begins) - 0.5) * np.array(self._step)
        self._edges = tuple(
            np.r_[centres - pixel / 2, centres[-1] + pixel / 2]
            for centres, pixel in zip((grid.x, grid.y), grid.pixel, strict=True)
        )
        self._sums = tuple(
            np.pad((field / math.prod(count)).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
            for field in (covered, np.where(covered, heights, 0))
        )

    def at(self, tip: Array) -> tuple[Array, Array]:
        """Return the covered part and the mean height of it [m], (nx, ny), tip at (3,) [m]."""
        fields = list(self._sums)
        for axis in range(2):
            position = (self._edges[axis] - tip[axis] - self._first[axis]) / self._step[axis]
            position = np.clip(position, 0.0, fields[0].shape[axis] - 1)
            before = np.minimum(position.astype(int), fields[0].shape[axis] - 2)
            weight = np.expand_dims(position - before, 1 - axis)
            fields = [
                np.diff(
                    (1 - weight) * field.take(before, axis) + weight * field.take(before + 1, axis),
                    axis=axis,
                )
                for field in fields
            ]
        covered, total = fields
        return covered, total / np.maximum(covered, TINY)


class Clearance:
    """Heights of an indenter, sampled once and interpolated as the tip moves.

    Samples lie under the pixels when the tip is at the motion's first waypoint, so a straight press
    reads the samples themselves. In between, the height is the cubic through the surrounding 4 x 4
    samples, limited to the range of the cell's corners. Where a wall crosses a pixel, the height is
    the mean of what covers it. There the indenter presses only the covered part, which yields more:
    by the pixel's own displacement under a pressure that is larger as the part is smaller.
    """

    def __init__(self, indenter: Indenter, grid: PixelGrid, motion: Motion) -> None:
        """Sample all of the indenter that the motion can bring over the body."""
        body, tip = grid.body, np.asarray(motion.tip)
        self._grid, self._anchor = grid, tip[0]
        self._step = tuple(pixel / FINENESS for pixel in grid.pixel)
        self.surface = body.heights(grid.x, grid.y)
        """Height of the undeformed top (nx, ny) [m]."""
        self._on_body = body.covers(grid.x[:, None], grid.y)
        self._cap = clearance_cap(motion, body, self.surface)
        far = tip[:, :2] - self._anchor[:2]
        origin, widths = [], []
        self._first: list[int] = []
        for axis, centres in enumerate((grid.x, grid.y)):
            low, high = -far[:, axis].max(), -far[:, axis].min()
            first = int(np.floor(low / self._step[axis])) - 2
            last = FINENESS * (len(centres) - 1) + int(np.ceil(high / self._step[axis])) + 3
            origin.append(float(centres[0] - self._anchor[axis]))
            widths.append(last + 1 - first)
            self._first.append(first)
        span = max(
            abs(start) + step * (abs(first) + width)
            for start, step, first, width in zip(
                origin, self._step, self._first, widths, strict=True
            )
        )
        reach = REACH * math.ceil(self._cap / REACH)
        begins, heights = _samples(indenter, (origin[0], origin[1]), self._step, span, reach)
        self._heights = np.full(widths, self._cap)
        runs = map(_common, self._first, widths, begins, heights.shape)
        ours, theirs = zip(*runs, strict=True)
        self._heights[ours] = np.minimum(heights[theirs], self._cap)
        self._rims = None if endless(indenter) else Rims(indenter, grid, span, reach)

    def at(self, tip: Array) -> tuple[Array, Array]:
        """Return gaps with the tip at (3,) [m], and how much more pixels yield, both (nx, ny).

        Gaps are in m, negative ones overlap. The second is in multiples of the displacement of a
        pixel by its own traction: 0 where the indenter covers all of it.
        """
        whole, rest = [], []
        for axis in range(2):
            offset = (self._anchor[axis] - tip[axis]) / self._step[axis]
            whole.append(int(np.floor(offset)) - self._first[axis])
            rest.append(offset - np.floor(offset))
        height = self._read(whole, rest)
        if self._rims is None:
            gap = np.where(self._on_body, height + tip[2] - self.surface, self._cap)
            return gap, np.zeros_like(gap)
        covered, mean = self._rims.at(tip)
        partly = (covered >= COVERED_LEAST) & (covered < COVERED_MOST)
        height = np.where(partly, np.minimum(mean, self._cap), height)
        height[covered < COVERED_LEAST] = self._cap
        gap = np.where(self._on_body, height + tip[2] - self.surface, self._cap)
        return gap, np.where(partly, YIELDING * (1 / np.where(partly, covered, 1.0) - 1), 0.0)

    def _read(self, whole: list[int], rest: list[float]) -> Array:
        nx, ny = self._grid.shape

        def sample(i: int, j: int) -> Array:
            return self._heights[_every(whole[0] + i, nx), _every(whole[1] + j, ny)]

        corners = [sample(i, j) for i in (0, 1) for j in (0, 1)]
        low, high = np.minimum.reduce(corners), np.maximum.reduce(corners)
        rows: Array = np.zeros((nx, self._heights.shape[1]))
        for i, weight in enumerate(_weights(rest[0])):
            rows += weight * self._heights[_every(whole[0] + i - 1, nx)]
        cubic: Array = np.zeros((nx, ny))
        for j, weight in enumerate(_weights(rest[1])):
            cubic += weight * rows[:, _every(whole[1] + j - 1, ny)]
        nearest = sample(int(rest[0] >= 0.5), int(rest[1] >= 0.5))
        return np.where(high < self._cap, np.clip(cubic, low, high), nearest)


def _common(first: int, count: int, other: int, many: int) -> tuple[slice, slice]:
    """Return the slices of two runs of samples that hold the same ones."""
    low, high = max(first, other), max(first, other, min(first + count, other + many))
    return slice(low - first, high - first), slice(low - other, high - other)


def _every(first: int, count: int) -> slice:
    """Return the slice of samples under `count` pixels, starting at sample `first`."""
    return slice(first, first + FINENESS * (count - 1) + 1, FINENESS)


def _weights(rest: float) -> tuple[float, float, float, float]:
    """Return Lagrange weights of the samples at -1, 0, 1, 2 for the position `rest`."""
    before, here, after, beyond = rest + 1, rest, rest - 1, rest - 2
    return (
        -here * after * beyond / 6,
        before * after * beyond / 2,
        -before * here * beyond / 2,
        before * here * after / 6,
    )
