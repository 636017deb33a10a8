"""Errors and coverage of a delivered model, on indenters that no stage learned from."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from learning.data.matching import SensorSelection
from learning.errors import LearningError
from learning.force.calibrate import presses_of_rows, shapes
from learning.force.intervals import Intervals, read_intervals
from learning.force.loading import load_force_model
from learning.metrics import (
    AXES,
    ForceErrors,
    axis_means,
    can_be_scored,
    force_errors,
    spread_and_range,
)
from learning.transfer.deliver import learned_indenters

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """Errors of predicted forces, and the share of true ones that their intervals contain."""

    errors: ForceErrors
    covered: NDArray[np.float64]
    """Share of frames of Fx, Fy, Fz within their interval (3,); NaN without a label."""
    covered_inside: NDArray[np.float64]
    """The same without the frames flagged as outside of what was learned."""
    outside: float
    """Share of frames flagged."""
    width: NDArray[np.float64]
    """Mean half-width of the intervals of Fx, Fy, Fz (3,) [N]."""
    indenters: tuple[str, ...]

    @property
    def coverage(self) -> float:
        """Mean over the measured axes."""
        return float(np.nanmean(self.covered))

    def lines(self) -> Iterator[str]:
        """Yield the lines to print; the last is the summary."""
        yield f"{self.errors.frames:,} frames of {', '.join(self.indenters)}"
        for axis, name in enumerate(AXES):
            if np.isfinite(self.errors.mae[axis]):
                interval = "no interval"
                if np.isfinite(self.covered[axis]):
                    interval = f"interval +- {self.width[axis]:.3f} N, covers "
                    interval += f"{100 * self.covered[axis]:.1f} %"
                yield (
                    f"{name.capitalize()}: R2 {self.errors.r2[axis]:.3f}  MAE "
                    f"{self.errors.mae[axis]:.3f} N  {interval}"
                )
        yield (
            f"{100 * self.outside:.1f} % of the frames flagged as outside of what was learned; "
            f"coverage of the others {100 * float(np.nanmean(self.covered_inside)):.1f} %"
        )
        yield (
            f"unlabelled sensor: R2 {self.errors.r2_mean:.3f}  MAE Fz {self.errors.mae[2]:.3f} N  "
            f"coverage of 90 % intervals {100 * self.coverage:.1f} %"
        )


@dataclass(frozen=True, slots=True, eq=False)
class NewFrames:
    """Frames of indenters that a model neither saw nor was calibrated on."""

    predicted: Floats
    """Predicted forces (n, 3) [N]."""
    true: Floats
    """Labels (n, 3) [N]."""
    shapes: Floats
    """Shapes of the frames (n, 7)."""
    indenters: tuple[str, ...]
    intervals: Intervals


def new_frames(model_folder: Path, truth: SensorSelection) -> NewFrames:
    """Predict the frames of an archive that are new to a model."""
    intervals = read_intervals(model_folder)
    if intervals is None:
        raise LearningError(
            f"{model_folder}: found no intervals; allowed: a model of `tactile force`"
        )
    seen = {*learned_indenters(model_folder), *intervals.indenters}
    sensor, model = truth.archive[truth.sensor], load_force_model(model_folder)
    names = np.array(truth.archive.indenters)[sensor.table["indenter"]]
    new = ~np.isin(names, sorted(seen))
    rows = np.flatnonzero(new & sensor.table["valid"] & (sensor.table["location"] >= 0))
    if not len(rows):
        raise LearningError(
            f"{truth.archive.name}: found no frame of an indenter beside "
            f"{', '.join(sorted(seen))}; allowed: some, to compare with"
        )
    presses = presses_of_rows(sensor, rows, model)
    rows = presses.rows.numpy()
    return NewFrames(
        model.predict(presses),
        np.asarray(sensor.table["wrench"][rows, :3], np.float64),
        shapes(sensor, rows),
        tuple(np.unique(names[rows]).tolist()),
        intervals,
    )


def score_of(new: NewFrames) -> Score:
    """Return errors and coverage on frames that are new to a model."""
    predicted, true = new.predicted, new.true
    if not can_be_scored(true, predicted):
        raise LearningError("found no label to compare with; allowed: true forces of the target")
    low, high = new.intervals.of(predicted)
    scored = np.isfinite(true) & np.isfinite(low)
    inside = (low <= true) & (true <= high)
    outside = new.intervals.is_outside(predicted, new.shapes)
    return Score(
        errors=force_errors(true, predicted, spread_and_range(true)[0]),
        covered=axis_means(np.where(scored, inside, np.nan)),
        covered_inside=axis_means(np.where(scored & ~outside[:, None], inside, np.nan)),
        outside=float(outside.mean()),
        width=axis_means(0.5 * (high - low)),
        indenters=new.indenters,
    )
