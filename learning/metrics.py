"""Errors of predicted forces: mean absolute error by axis and of the magnitude, and R2.

The definitions are the paper's (Methods, and the supplement, Text 2): the mean absolute error of
each axis and of the force magnitude, and the coefficient of determination over all frames of a
test, across presses.
"""

from __future__ import annotations

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
    """Errors over a set of frames."""

    frames: int
    """Number of frames."""
    mae: tuple[float, float, float, float]
    """Mean absolute error of Fx, Fy, Fz and Ft [N]."""
    relative: tuple[float, float, float, float]
    """The same divided by the standard deviation of the target's labels."""
    r2: tuple[float, float, float]
    """Coefficient of determination of Fx, Fy and Fz; NaN if the labels are constant."""

    @property
    def r2_mean(self) -> float:
        """Mean of R2 over the axes."""
        return float(np.mean(self.r2))

    @property
    def shear(self) -> float:
        """Mean of the errors of Fx and Fy [N]."""
        return 0.5 * (self.mae[0] + self.mae[1])


def force_errors(true: Floats, predicted: Floats, spread: Floats) -> ForceErrors:
    """Return the errors of predicted forces.

    Args:
        true: Measured forces (n, 3) [N].
        predicted: Predicted forces (n, 3) [N].
        spread: Standard deviation of the target's labels, of Fx, Fy, Fz and Ft (4,) [N].

    Raises:
        LearningError: There are no frames, shapes differ, or a force is not finite.
    """
    mae = mean_absolute_error(with_magnitude(true), with_magnitude(predicted))
    # The relative error to constant labels is infinite, or NaN if the error is zero.
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = mae / np.asarray(spread, np.float64)
    fx, fy, fz = r_squared(true, predicted).tolist()
    return ForceErrors(len(true), _four(mae), _four(relative), (fx, fy, fz))


def mean_absolute_error(true: Floats, predicted: Floats) -> Floats:
    """Return the mean over frames of |predicted - true| (k,), in the units of the inputs (n, k).

    Raises:
        LearningError: There are no frames, shapes differ, or a value is not finite.
    """
    _require_alike(true, predicted)
    return np.asarray(np.abs(predicted - true).mean(axis=0), np.float64)


def r_squared(true: Floats, predicted: Floats) -> Floats:
    """Return the coefficient of determination of each column (k,) of (n, k).

    1 - sum (predicted - true)^2 / sum (true - mean of true)^2, over all frames. 1 is perfect, 0 is
    as good as always predicting the mean, negative is worse. NaN where true is constant.

    Raises:
        LearningError: There are no frames, shapes differ, or a value is not finite.
    """
    _require_alike(true, predicted)
    missed = np.square(predicted - true).sum(axis=0)
    varied = np.square(true - true.mean(axis=0)).sum(axis=0)
    constant = np.ptp(true, axis=0) == 0
    return np.where(constant, np.nan, 1 - missed / np.where(constant, 1, varied))


def with_magnitude(forces: Floats) -> Floats:
    """Return forces (n, 4) [N]: Fx, Fy, Fz (n, 3) and their magnitude, the paper's total force Ft.

    Raises:
        LearningError: Not (n, 3).
    """
    forces = np.asarray(forces, np.float64)
    if forces.ndim != 2 or forces.shape[1] != 3:
        raise LearningError(f"forces: found shape {forces.shape}; allowed: (n, 3)")
    return np.concatenate([forces, np.linalg.norm(forces, axis=1, keepdims=True)], axis=1)


def spread_and_range(labels: Floats) -> tuple[Floats, Floats]:
    """Return standard deviation (4,) and range (4,) of Fx, Fy, Fz, Ft [N] of labels (n, 3).

    Rows without a label (NaN) are ignored.

    Raises:
        LearningError: The shape is not (n, 3), or there is no label.
    """
    found = with_magnitude(labels)
    found = found[np.isfinite(found).all(axis=1)]
    if not len(found):
        raise LearningError("labels: found none that is a number; allowed: one force or more")
    return found.std(axis=0), np.ptp(found, axis=0)


def _require_alike(true: Floats, predicted: Floats) -> None:
    if true.shape != predicted.shape or true.ndim != 2 or not len(true):
        raise LearningError(
            f"forces: found true {true.shape} and predicted {predicted.shape}; allowed: the same "
            "shape, of one frame or more"
        )
    for name, values in (("true", true), ("predicted", predicted)):
        wrong = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if wrong.size:
            raise LearningError(
                f"forces: found {values[wrong[0]]} in row {wrong[0]} of {name}, and "
                f"{wrong.size} such rows; allowed: numbers"
            )


def _four(values: Floats) -> tuple[float, float, float, float]:
    fx, fy, fz, ft = values.tolist()
    return fx, fy, fz, ft
