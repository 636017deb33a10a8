"""Search for d0 and lambda, by the target's labels (an oracle) or by the priors alone.

The paper searches a grid and does not state the criterion. Here there are two; a choice is best

- **for labels** if the mean distance between compensated labels and the target's labels at paired
locations is smallest. It needs the target's labels, with which no transfer is needed: it is an
upper bound.
- **for priors** if the expected squared error of the compensated force-depth curve is smallest. The
difference of the two curves is known up to the variance v of the fits' residuals, so a correction
of lambda times the difference has a mean error of ((1 - lambda)^2 (difference^2 - v) + lambda^2 v)
(Stein's unbiased estimate). It needs no label of the target, and weakens corrections that are
noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from learning.compensation.prior import Prior, compensate, ratios, require_choice
from learning.data.splits import read_split
from learning.errors import LearningError
from learning.metrics import axis_means, r_squared
from recorder import PHASES, MarkerArchive
from recorder.archive import ArchivedSensor, location_pairs

Floats = NDArray[np.float64]

# Starting depths of the material test (supplement, Table S1).
D0_MM = (0.0, 0.4, 0.8)
# Starting depths of the heterogeneous test, of the depth range (supplement, Table S2).
D0_SHARES = (0.0, 0.25, 0.5, 0.75)
# Weights (supplement, Tables S1 and S2).
WEIGHTS = (0.0, 0.25, 0.5, 0.75, 1.0)
_SHARES = np.linspace(0.0, 1.0, 101)[1:]


@dataclass(frozen=True, slots=True)
class Choice:
    """A starting depth, a weight and their errors."""

    d0: float
    """Fraction of the source's depth range."""
    weight: float
    """Lambda."""
    error: float | None
    """Mean distance of compensated labels from the target's [N]; None if the target has none."""
    axes: tuple[float | None, ...] = ()
    """Mean absolute error of Fx, Fy, Fz [N]; None for an axis that one of the two has no label of.

    `error` is over the other axes.
    """
    clamped: int = 0
    """Number of labels whose ratio was clamped."""
    r2: float | None = None
    """R2 of compensated labels as predictions of the target's: mean over the axes.

    A model trained on these labels exceeds it only by chance. None if the target's labels are
    constant.
    """

    def __post_init__(self) -> None:
        require_choice(self.d0, self.weight)


@dataclass(frozen=True, slots=True, eq=False)
class PairedLabels:
    """Labels of two sensors at their common locations."""

    source: Floats
    """Forces (n, 3) [N]; NaN on axes that one of the two sensors has no label of."""
    target: Floats
    """Forces (n, 3) [N]; NaN on the same axes."""
    depth: Floats
    """Indentation of the source (n,) [m]."""
    phase: NDArray[np.int64]
    """Codes of phases (n,)."""

    def __len__(self) -> int:
        return len(self.source)


def scored_choice(
    paired: PairedLabels | None, source: Prior, target: Prior, d0: float, weight: float
) -> Choice:
    """Return a choice, with its error if the target's labels are known."""
    if paired is None or not len(paired):
        return Choice(d0, weight, None)
    labels, clamped = compensate(
        paired.source, paired.depth, paired.phase, source, target, d0, weight
    )
    apart = labels - paired.target
    labelled = np.isfinite(apart)
    if np.isinf(apart).any() or not labelled.any(axis=1).all():
        raise LearningError(
            f"{target.sensor}.wrench: found no finite label in some of the paired locations; "
            "allowed: one axis or more in each"
        )
    means = axis_means(np.abs(apart)).tolist()
    axes = tuple(None if np.isnan(value) else float(value) for value in means)
    error = float(np.linalg.norm(np.where(labelled, apart, 0.0), axis=1).mean())
    return Choice(d0, weight, error, axes, clamped, label_r2(paired.target, labels))


def label_r2(true: Floats, labels: Floats) -> float | None:
    """Return R2 of labels (n, 3) as predictions of others, mean over axes; None if unknown."""
    fits = []
    for one, other in zip(true.T, labels.T, strict=True):
        rows = np.isfinite(one) & np.isfinite(other)
        if rows.any():
            fits.append(r_squared(one[rows, None], other[rows, None])[0])
    return float(np.mean(fits)) if fits and np.isfinite(fits).all() else None


def best_for_labels(
    paired: PairedLabels, source: Prior, target: Prior, d0s: Sequence[float] = D0_SHARES
) -> Choice:
    """Return the choice with labels nearest to the target's; ties go to the smallest lambda.

    Starting depths `d0s` are fractions of the source's range.
    """
    choices = [
        scored_choice(paired, source, target, d0, weight) for weight in WEIGHTS for d0 in d0s
    ]
    return min(choices, key=lambda choice: np.inf if choice.error is None else choice.error)


def best_for_priors(
    source: Prior, target: Prior, d0s: Sequence[float] = D0_SHARES
) -> tuple[float, float] | None:
    """Return d0 and lambda of least expected error; None if a prior has no residual."""
    branches = (prior.branch(loading) for prior in (source, target) for loading in (True, False))
    if any(branch.residual is None for branch in branches):
        return None
    choices = [(d0, weight) for weight in WEIGHTS for d0 in d0s]
    return min(choices, key=lambda choice: _expected_error(source, target, *choice))


def _expected_error(source: Prior, target: Prior, d0: float, weight: float) -> float:
    """Return the expected mean square error of the source's compensated curve [N^2]."""
    parts = []
    for loading in (True, False):
        own, other = source.branch(loading), target.branch(loading)
        code = PHASES.index("normal_inc" if loading else "normal_dec")
        depth = _SHARES * source.depth_range
        ratio, _ = ratios(depth, np.full(len(depth), code), source, target)
        correction = own.compression(_SHARES) * (ratio - 1.0)
        variance = (other.residual or 0.0) ** 2 + (ratio * (own.residual or 0.0)) ** 2
        lam = np.where(d0 < _SHARES, weight, 0.0)
        parts.append((1 - lam) ** 2 * (correction**2 - variance) + lam**2 * variance)
    return float(np.mean(parts))


# Labels of two sensors of an archive at the same locations, from presses that may be trained on.


def paired_labels(
    archive: MarkerArchive, source: str, target: str, split: Path | None = None
) -> PairedLabels | None:
    """Return labels at paired locations; None if there are none.

    Uses the last frames of the phases, of the training presses of a split or, without one, of all
    seen indenters.
    """
    one, other = archive[source], archive[target]
    pairs = location_pairs(one.table, other.table)
    usable = training_mask(archive, one, pairs.source, split)
    forces = one.table["wrench"][pairs.source, :3], other.table["wrench"][pairs.target, :3]
    both = np.isfinite(forces[0]) & np.isfinite(forces[1])
    usable &= both.any(axis=1)
    if not usable.any():
        return None
    return PairedLabels(
        np.where(both, forces[0], np.nan)[usable],
        np.where(both, forces[1], np.nan)[usable],
        one.table["depth"][pairs.source][usable],
        one.table["phase"][pairs.source][usable].astype(np.int64),
    )


def depth_range(sensor: ArchivedSensor) -> float | None:
    """Return the greatest depth of a sensor's located presses [m]; None without any."""
    rows = (sensor.table["location"] >= 0) & sensor.table["valid"]
    deepest = float(sensor.table["depth"][rows].max(initial=0.0))
    return deepest if deepest > 0 else None


def training_mask(
    archive: MarkerArchive, sensor: ArchivedSensor, rows: NDArray[np.int64], split: Path | None
) -> NDArray[np.bool_]:
    """Return a mask (n,) of the rows that may be trained on: of a split, or of seen indenters."""
    if split is None:
        return np.asarray(sensor.table["seen"][rows], np.bool_)
    stored = read_split(split)
    stored.check(archive)
    roles = np.asarray(stored.role(sensor.table["location"][rows]))
    training = np.asarray(roles == "train", np.bool_)
    if not training.any():
        raise LearningError(f"{split}: trains on no press of {sensor.name}; allowed: one or more")
    return training
