"""Optional stage: a few labelled presses of the target set the scale, and measure the error."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from learning.data.labels import Labels
from learning.force.intervals import Held, Intervals, Scale, measured_scale
from learning.metrics import force_errors, spread_and_range

Floats = NDArray[np.float64]

# Numbers of labelled presses whose errors the report lists.
COUNTS = (0, 1, 5, 20, 100)
# Labelled presses of an axis from which it has a gain of its own, as shear and pressing may
# differ; below, all axes have the same. Offsets are not corrected: they would show without contact.
GAINS_FROM = 5
# Largest ratio of an axis's gain and the common one.
_GAIN_MOST = 2.0


def gains_of_labels(
    labels: Labels, predicted: Floats, intervals: Intervals
) -> tuple[Floats, Scale, str]:
    """Return factors on predicted forces (3,), their remaining uncertainty, and a sentence.

    Args:
        labels: Labels of the target.
        predicted: Forces predicted there (n, 3) [N].
        intervals: Intervals of the model.
    """
    text = f"scale from {labels.presses} labelled presses of the target"
    gains, scale = _gains(labels, predicted, intervals, labels.presses, text)
    listed = ", ".join(f"{gain:.3f}" for gain in gains)
    told = f"factors of Fx, Fy, Fz {listed}" if np.ptp(gains) else f"factor {gains[0]:.3f}"
    return gains, scale, f"{text}: {told}"


def error_curve(labels: Labels, predicted: Floats, intervals: Intervals) -> list[dict[str, str]]:
    """Return the errors after 0, 1, 5, 20 and 100 labelled presses, as far as there are as many.

    All are errors on the same presses: a third of the labelled ones, which set no scale here.
    """
    held = max(1, labels.presses // 3)
    if labels.presses < 2:
        return []
    tested = labels.press >= labels.presses - held
    spread, _ = spread_and_range(labels.forces)
    lines = []
    for count in [n for n in COUNTS if n <= labels.presses - held]:
        gains = np.ones(3) if not count else _gains(labels, predicted, intervals, count, "")[0]
        errors = force_errors(labels.forces[tested], gains * predicted[tested], spread)
        lines.append(
            {
                "labelled presses": str(count),
                "factor": " ".join(
                    f"{gain:.3f}" for gain in (gains if np.ptp(gains) else gains[:1])
                ),
                **{
                    f"MAE {axis} [N]": f"{mae:.3f}" if np.isfinite(mae) else "-"
                    for axis, mae in zip(("Fx", "Fy", "Fz"), errors.mae, strict=False)
                },
                f"R2{errors.of_axes}": f"{errors.r2_mean:.3f}",
                "tested presses": str(held),
            }
        )
    return lines


def _gains(
    labels: Labels, predicted: Floats, intervals: Intervals, presses: int, source: str
) -> tuple[Floats, Scale]:
    """Return the factor of each axis by the first presses: with few of them, the common one."""
    value, scale = _scale(labels, predicted, intervals, presses, source)
    gains = np.full(3, value)
    for axis in range(3):
        known = np.isfinite(labels.forces[:, axis]) & np.isfinite(predicted[:, axis])
        known &= labels.press < presses
        if len(np.unique(labels.press[known])) < GAINS_FROM:
            continue
        x, y = value * predicted[known, axis], labels.forces[known, axis]
        gain = float((x * y).sum()) / max(float((x**2).sum()), 1e-12)
        gains[axis] *= min(max(gain, 1 / _GAIN_MOST), _GAIN_MOST)
    return gains, scale


def _scale(
    labels: Labels, predicted: Floats, intervals: Intervals, presses: int, source: str
) -> tuple[float, Scale]:
    """Return the scale by the strongest labelled force of each of the first presses."""
    held: list[Held] = []
    low, high = intervals.rescaled(1.0, Scale(1.0, "", False)).of(predicted)
    error = 0.5 * (high - low)
    for press in range(presses):
        rows = np.flatnonzero(labels.press == press)
        size = np.abs(np.where(np.isfinite(error[rows]), labels.forces[rows], np.nan))
        if np.isnan(size).all():
            continue
        place, axis = divmod(int(np.nanargmax(size)), 3)
        row = rows[place]
        held.append(
            Held(
                float(labels.forces[row, axis]),
                float(predicted[row, axis]),
                float(error[row, axis]),
            )
        )
    return measured_scale(held, intervals.scale, source, independent=len(held))
