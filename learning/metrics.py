"""Errors of predicted forces: mean absolute error by axis and of the magnitude, and R2.

The definitions are the paper's (Methods, and the supplement, Text 2): the mean absolute error of
each axis and of the force magnitude, and the coefficient of determination over all frames of a
test, across presses.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError

Floats = NDArray[np.float64]

AXES = ("fx", "fy", "fz")
# Quantities with an error: the axes, and the magnitude of the force.
MEASURED = (*AXES, "ft")


@dataclass(frozen=True, slots=True)
class ForceErrors:
    """Errors over a set of frames; NaN for axes without a label or a prediction."""

    frames: int
    """Number of frames with a label on one axis or more."""
    mae: tuple[float, ...]
    """Mean absolute error of Fx, Fy, Fz and Ft [N]; Ft of frames with all three axes."""
    relative: tuple[float, ...]
    """The same divided by the standard deviation of the target's labels."""
    r2: tuple[float, ...]
    """Coefficient of determination of Fx, Fy and Fz; NaN if labels are constant or missing."""

    @property
    def r2_mean(self) -> float:
        """Mean of R2 over the measured axes; NaN if the labels of one of them are constant."""
        measured = [fit for fit, mae in zip(self.r2, self.mae, strict=False) if np.isfinite(mae)]
        return float(np.mean(measured)) if measured else np.nan

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes that were measured and predicted, e.g. Fx."""
        named = zip(AXES, self.mae, strict=False)
        return tuple(name.capitalize() for name, mae in named if np.isfinite(mae))

    @property
    def of_axes(self) -> str:
        """Text that says which axes a mean is of, unless all: ` (Fz)`."""
        return "" if len(self.axes) == len(AXES) else f" ({', '.join(self.axes)})"

    @property
    def shear(self) -> float:
        """Mean of the errors of Fx and Fy [N]."""
        return 0.5 * (self.mae[0] + self.mae[1])


def force_errors(true: Floats, predicted: Floats, spread: Floats) -> ForceErrors:
    """Return the errors of predicted forces (n, 3) [N]; NaN is no label, or an axis without one.

    `spread` is the standard deviation of the target's labels, of Fx, Fy, Fz and Ft (4,) [N].
    """
    comparable = _comparable(true, predicted)
    measured, estimated = with_magnitude(true), with_magnitude(predicted)
    mae, fit = np.full(len(MEASURED), np.nan), np.full(len(AXES), np.nan)
    for column in range(len(MEASURED)):
        rows = comparable[:, column] if column < len(AXES) else comparable.all(axis=1)
        if not rows.any():
            continue
        one, other = measured[rows, column, None], estimated[rows, column, None]
        mae[column] = np.abs(other - one).mean(axis=0)[0]
        if column < len(AXES):
            fit[column] = r_squared(one, other)[0]
    # The relative error to constant labels is infinite, or NaN if the error is zero.
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = mae / np.asarray(spread, np.float64)
    scored = int(comparable.any(axis=1).sum())
    return ForceErrors(scored, *(tuple(each.tolist()) for each in (mae, relative, fit)))


def by_axis(names: Iterable[str], values: Iterable[float]) -> str:
    """Return values by the names of their axes as text, `-` for NaN."""
    pairs = zip(names, values, strict=True)
    return "  ".join(
        f"{name} {value:.3f}" if value == value else f"{name} -" for name, value in pairs
    )


def can_be_scored(true: Floats, predicted: Floats) -> bool:
    """Return True if a label (n, 3) can be compared with a prediction (n, 3)."""
    return bool((np.isfinite(true) & np.isfinite(predicted)).any())


def axis_means(values: Floats) -> Floats:
    """Return the mean of each column (k,) of (n, k) without its NaN; NaN if there is no other."""
    present = ~np.isnan(values)
    total, count = np.where(present, values, 0.0).sum(axis=0), present.sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _comparable(true: Floats, predicted: Floats) -> NDArray[np.bool_]:
    """Return a mask (n, 3) of the labels that a prediction can be compared with."""
    if true.shape != predicted.shape or true.ndim != 2 or not len(true):
        raise LearningError(
            f"forces: found true {true.shape} and predicted {predicted.shape}; allowed: the same "
            "shape, of one frame or more"
        )
    require_forces("true", true, whole_axes=False)
    require_forces("predicted", predicted, whole_axes=True)
    comparable: NDArray[np.bool_] = np.isfinite(true) & np.isfinite(predicted)
    if not comparable.any():
        raise LearningError(
            "forces: found no label that a prediction can be compared with; allowed: one or more"
        )
    return comparable


def require_forces(name: str, forces: Floats, *, whole_axes: bool) -> None:
    """Reject infinite forces (n, 3); with `whole_axes`, also NaN in a part of an axis's frames."""
    wrong = np.isinf(forces)
    if whole_axes:
        wrong |= np.isnan(forces) & ~np.isnan(forces).all(axis=0)
    rows = np.flatnonzero(wrong.any(axis=1))
    if rows.size:
        raise LearningError(
            f"forces: found {forces[rows[0]]} in row {rows[0]} of {name}, and {rows.size} such "
            f"rows; allowed: numbers, or NaN {'on a whole axis' if whole_axes else 'as no label'}"
        )


def r_squared(true: Floats, predicted: Floats) -> Floats:
    """Return the coefficient of determination of each column (k,) of (n, k).

    1 - sum (predicted - true)^2 / sum (true - mean of true)^2, over all frames. 1 is perfect, 0 is
    as good as always predicting the mean, negative is worse. NaN where true is constant.
    """
    missed = np.square(predicted - true).sum(axis=0)
    varied = np.square(true - true.mean(axis=0)).sum(axis=0)
    constant = np.ptp(true, axis=0) == 0
    return np.where(constant, np.nan, 1 - missed / np.where(constant, 1, varied))


def with_magnitude(forces: Floats) -> Floats:
    """Return forces (n, 4) [N]: Fx, Fy, Fz (n, 3) and their magnitude, the paper's Ft."""
    forces = np.asarray(forces, np.float64)
    if forces.ndim != 2 or forces.shape[1] != 3:
        raise LearningError(f"forces: found shape {forces.shape}; allowed: (n, 3)")
    return np.concatenate([forces, np.linalg.norm(forces, axis=1, keepdims=True)], axis=1)


def spread_and_range(labels: Floats) -> tuple[Floats, Floats]:
    """Return standard deviation (4,) and range (4,) of Fx, Fy, Fz, Ft [N] of labels (n, 3).

    Each is of its measured frames (not NaN), Ft of those with all axes; NaN without any.
    """
    forces = with_magnitude(labels)
    spread, range_ = np.full(forces.shape[1], np.nan), np.full(forces.shape[1], np.nan)
    for index, column in enumerate(forces.T):
        finite = column[np.isfinite(column)]
        if len(finite):
            spread[index], range_[index] = finite.std(), np.ptp(finite)
    return spread, range_
