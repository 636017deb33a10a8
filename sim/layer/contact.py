"""Contact of a layer: pressure is never tensile, shear never exceeds Coulomb's limit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.indenters import Indenter
from sim.layer.spectral import Elastic, Grid
from sim.scene import Motion

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
class Found:
    """Result of a descent."""

    x: Array
    slope: Array
    """A x + b at the result."""
    residual: float
    iterations: int


def descend(
    problem: Problem, x: Array, slope: Array, *, tolerance: float, iterations: int
) -> Found:
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
    return Found(x, slope, residual, done)


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
    found = descend(
        Problem(body.answer.normal, _pushing, body.local_normal),
        pressure,
        gap + body.answer.normal(pressure),
        tolerance=tolerance,
        iterations=ITERATIONS,
    )
    traction = np.stack([np.zeros_like(gap), np.zeros_like(gap), -found.x])
    return Contact(traction, found.residual, found.iterations)


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
    inside: Array = shear * (bound / np.maximum(np.maximum(length, bound), TINY))
    return inside


# Gap between the undeformed body and the indenter, for any position of its tip.

# Samples of the indenter's lower surface per width of a pixel.
FINENESS = 2


class Clearance:
    """Heights of an indenter, sampled once and interpolated as the tip moves.

    Samples lie under the pixels when the tip is at the motion's first waypoint, so a straight press
    reads the samples themselves. In between, the height is the cubic through the surrounding 4 x 4
    samples, limited to the range of the cell's corners. In a cell with a corner that cannot touch
    it is the nearest sample's, which keeps the position of a wall on average.
    """

    def __init__(self, indenter: Indenter, grid: Grid, motion: Motion) -> None:
        """Sample all of the indenter that the motion can bring over the body."""
        body, tip = grid.body, np.asarray(motion.tip)
        self._grid, self._anchor = grid, tip[0]
        self._step = tuple(pixel / FINENESS for pixel in grid.pixel)
        self.surface = body.heights(grid.x, grid.y)
        """Height of the undeformed top (nx, ny) [m]."""
        self._on_body = body.covers(grid.x[:, None], grid.y)
        self._cap = 2 * (motion.depth_max - float(self.surface.min())) + body.thickness / 2
        far = tip[:, :2] - self._anchor[:2]
        samples = []
        self._first: list[int] = []
        for axis, centres in enumerate((grid.x, grid.y)):
            low, high = -far[:, axis].max(), -far[:, axis].min()
            first = int(np.floor(low / self._step[axis])) - 2
            last = FINENESS * (len(centres) - 1) + int(np.ceil(high / self._step[axis])) + 3
            offsets = np.arange(first, last + 1) * self._step[axis]
            samples.append(centres[0] - self._anchor[axis] + offsets)
            self._first.append(first)
        heights = indenter.heights(samples[0][:, None], samples[1][None, :], reach=self._cap)
        self._heights = np.minimum(heights, self._cap)

    def at(self, tip: Array) -> Array:
        """Return the gap at every pixel (nx, ny) with the tip at (3,) [m]; negative: overlap."""
        whole, rest = [], []
        for axis in range(2):
            place = (self._anchor[axis] - tip[axis]) / self._step[axis]
            whole.append(int(np.floor(place)) - self._first[axis])
            rest.append(place - np.floor(place))
        gap: Array = self._read(whole, rest) + tip[2] - self.surface
        return np.where(self._on_body, gap, self._cap)

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
