"""Projected gradient descent: the least of a quadratic energy within simple bounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True, slots=True)
class Problem:
    """Find x within bounds for which 1/2 x.A x + b.x is least."""

    apply: Callable[[Array], Array]
    """A x; A is symmetric and positive."""
    project: Callable[[Array], Array]
    """The nearest point within the bounds."""
    local: float
    """A typical element of A's diagonal."""
    scale: float | None = None
    """Norm that residuals are compared with; None: the norm of x itself."""

    def residual(self, x: Array, slope: Array) -> float:
        """|x - project(x - slope / local)| over the scale: 0 at the solution only, at most 1."""
        distance = float(np.linalg.norm(x - self.project(x - slope / self.local)))
        scale = float(np.linalg.norm(x)) if self.scale is None else self.scale
        return distance / max(scale, distance) if distance > 0 else 0.0


@dataclass(frozen=True, slots=True)
class Found:
    """Where a descent ended."""

    x: Array
    slope: Array
    """A x + b there."""
    residual: float
    iterations: int


def descend(
    problem: Problem, x: Array, slope: Array, *, tolerance: float, iterations: int
) -> Found:
    """Go down from `x` (within the bounds, with its slope) to a residual of `tolerance`.

    Ends earlier after `iterations`. Step lengths are Barzilai and Borwein's (IMA J. Numer. Anal. 8
    (1988) 141), long and short by turns. The energy falls in each iteration, because a move ends
    where it is least on the way (Birgin, Martinez & Raydan, SIAM J. Optim. 10 (2000) 1196, with the
    exact search that a quadratic allows). Each iteration takes one product with A.
    """
    step, done = 1 / problem.local, 0
    residual = problem.residual(x, slope)
    while residual > tolerance and done < iterations:
        done += 1
        move = problem.project(x - step * slope) - x
        answer = problem.apply(move)
        curvature, size = float(np.vdot(move, answer)), float(np.vdot(answer, answer))
        if not (curvature > 0 and size > 0):
            break  # nothing is left that a number can hold: squares vanish before residuals do
        share = min(1.0, -float(np.vdot(slope, move)) / curvature)
        x = x + share * move
        slope = slope + share * answer
        step = float(np.vdot(move, move)) / curvature if done % 2 else curvature / size
        residual = problem.residual(x, slope)
    return Found(x, slope, residual, done)
