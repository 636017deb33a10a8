"""Which d0 and lambda: by the target's labels (an oracle), or by the priors alone.

The paper searches a grid and does not say what for. Here, of the choices on a grid, one is best

- **for labels**: the mean distance between compensated labels and the target's own at paired
  locations is the smallest. Whoever can compute it needs no transfer: it is an upper bound.
- **for priors**: the expected squared error of the compensated force-depth curve is the smallest.
  The difference of the two curves is known up to the variance v of what the fits left over, so
  lambda times it is wrong by ((1 - lambda)^2 (difference^2 - v) + lambda^2 v) on average (Stein's
  unbiased estimate). It needs no label of the target, and weakens corrections that are noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from learning.compensation.correction import compensate, ratios
from learning.compensation.prior import Prior
from learning.errors import LearningError
from learning.force_errors import r_squared
from recorder import PHASES

Floats = NDArray[np.float64]

D0_MM = (0.0, 0.4, 0.8)
"""Starting depths of the material test (supplement, Table S1)."""
D0_SHARES = (0.0, 0.25, 0.5, 0.75)
"""Starting depths of the heterogeneous test, of the depth range (supplement, Table S2)."""
WEIGHTS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Weights (supplement, Tables S1 and S2)."""
_SHARES = np.linspace(0.0, 1.0, 101)[1:]


@dataclass(frozen=True, slots=True)
class Grid:
    """Choices that are tried."""

    d0: tuple[float, ...] = D0_SHARES
    """Starting depths, shares of the source's range."""
    weights: tuple[float, ...] = WEIGHTS

    def __post_init__(self) -> None:
        """Refuse an empty grid, or one beyond the paper's ranges."""
        for name, values in (("d0", self.d0), ("lambda", self.weights)):
            if not values or not all(0.0 <= value <= 1.0 for value in values):
                raise LearningError(f"{name}: found {values}; allowed: one or more, 0 to 1")


@dataclass(frozen=True, slots=True)
class Choice:
    """A starting depth and a weight, and how good they are."""

    d0: float
    """Share of the source's depth range."""
    weight: float
    """Lambda."""
    error: float | None
    """Mean distance of compensated labels from the target's [N]; None where it has none."""
    axes: tuple[float, ...] = ()
    """Mean absolute error of Fx, Fy, Fz [N]."""
    clamped: int = 0
    """Labels whose ratio was clamped."""
    r2: float | None = None
    """R2 of compensated labels, were they predictions of the target's: mean over the axes. No model
    that learns from them does better but by chance. None where the target's never change."""


@dataclass(frozen=True, slots=True, eq=False)
class Paired:
    """Labels of two sensors where both were pressed alike."""

    source: Floats
    """Forces (n, 3) [N]."""
    target: Floats
    """Forces (n, 3) [N]."""
    depth: Floats
    """Indentation of the source (n,) [m]."""
    phase: NDArray[np.int64]
    """Codes of phases (n,)."""

    def __len__(self) -> int:
        """Return the number of pairs."""
        return len(self.source)


def tried(paired: Paired | None, source: Prior, target: Prior, d0: float, weight: float) -> Choice:
    """Return a choice, with its error where the target's labels are known.

    Raises:
        LearningError: Labels that are no numbers, or a choice outside of the paper's ranges.
    """
    if paired is None or not len(paired):
        return Choice(d0, weight, None)
    labels, clamped = compensate(
        paired.source, paired.depth, paired.phase, source, target, d0, weight
    )
    apart = labels - paired.target
    if not np.isfinite(apart).all():
        raise LearningError(
            f"{target.sensor}.wrench: found NaN in labels of paired locations; allowed: numbers"
        )
    axes = tuple(float(value) for value in np.abs(apart).mean(axis=0))
    error = float(np.linalg.norm(apart, axis=1).mean())
    fit = float(r_squared(paired.target, labels).mean())
    return Choice(d0, weight, error, axes, clamped, fit if np.isfinite(fit) else None)


def best_for_labels(paired: Paired, source: Prior, target: Prior, grid: Grid) -> Choice:
    """Return the choice whose labels are nearest to the target's; the weakest of equals.

    Raises:
        LearningError: No pairs, or labels that are no numbers.
    """
    if not len(paired):
        raise LearningError(
            f"{source.sensor}, {target.sensor}: found no paired labels; allowed: one or more"
        )
    choices = [
        tried(paired, source, target, d0, weight) for weight in grid.weights for d0 in grid.d0
    ]
    return min(choices, key=lambda choice: np.inf if choice.error is None else choice.error)


def best_for_priors(source: Prior, target: Prior, grid: Grid) -> tuple[float, float] | None:
    """Return d0 and lambda with the smallest expected error of the curves.

    None where a prior does not say how well it fits.
    """
    risks = {}
    for weight in grid.weights:
        for d0 in grid.d0:
            risk = expected_error(source, target, d0, weight)
            if risk is None:
                return None
            risks[d0, weight] = risk
    return min(risks, key=lambda choice: risks[choice])


def expected_error(source: Prior, target: Prior, d0: float, weight: float) -> float | None:
    """Return the expected mean square error of the source's compensated curve [N^2].

    None where a prior does not say how well it fits.
    """
    parts = []
    for loading in (True, False):
        own, other = source.branch(loading), target.branch(loading)
        if own.residual is None or other.residual is None:
            return None
        code = PHASES.index("normal_inc" if loading else "normal_dec")
        depth = _SHARES * source.depth_range
        ratio, _ = ratios(depth, np.full(len(depth), code), source, target)
        force = own.compression(_SHARES)
        correction = force * (ratio - 1.0)
        variance = other.residual**2 + (ratio * own.residual) ** 2
        lam = np.where(d0 < _SHARES, weight, 0.0)
        parts.append((1 - lam) ** 2 * (correction**2 - variance) + lam**2 * variance)
    return float(np.mean(parts))
