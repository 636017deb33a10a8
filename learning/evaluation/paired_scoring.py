"""Scores frames beside the real ones of the same presses and phases."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from learning.evaluation.marker_errors import endpoint_errors, marker_errors
from learning.evaluation.overlap import overlap
from learning.evaluation.translation_scores import PairedScore
from recorder.archive import ArchivedSensor
from recorder.markers import SMALLEST_PX, unpack

Rows = NDArray[np.int64]
Packed = NDArray[np.uint8]
Floats = NDArray[np.float64]

_AT_ONCE = 64


@dataclass(frozen=True, slots=True, eq=False)
class Real:
    """Real frames of the target, which others are judged by."""

    sensor: ArchivedSensor
    """The target."""
    rows: Rows
    """Which of its frames (n,)."""
    packed: Packed
    """Their packed masks (n, 38400)."""
    mm: Floats
    """Size of a pixel along columns and along rows (2,) [mm]."""

    @property
    def smallest_px(self) -> int:
        """Patches of fewer pixels are no markers of it."""
        return int((self.sensor.attrs.get("marker_check") or {}).get("smallest_px", SMALLEST_PX))


def real_frames(sensor: ArchivedSensor, rows: Rows) -> Real:
    """Return real frames of a target.

    Raises:
        SessionError: A chunk is missing or damaged.
    """
    from learning.translation.translator import SensorView

    view = SensorView.of(sensor)
    mm = np.array([view.mm_per_column, view.mm_per_row])
    return Real(sensor, rows, sensor.packed(rows), mm)


def paired_score(packed: Packed, real: Real, role: str, method: str) -> PairedScore:
    """Return the score of frames (n, 38400) beside the real ones of the same presses and phases.

    Raises:
        LearningError: Not as many.
        SessionError: A chunk of the displacement is missing or damaged.
    """
    if packed.shape != real.packed.shape:
        raise LearningError(
            f"{real.sensor.name}: found {packed.shape} frames of {real.packed.shape}; allowed: "
            "as many, packed"
        )
    dice, iou, area, apart, wrong, missed = [], [], [], [], [], []
    sensor = real.sensor
    for first in range(0, len(packed), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        found, true = unpack(packed[part]), unpack(real.packed[part])
        covered = overlap(found, true)
        dice.append(covered.dice)
        iou.append(covered.iou)
        area.append(covered.area_ratio_error)
        markers = marker_errors(found, true, real.smallest_px)
        apart.append(markers.apart)
        wrong.append(markers.mismatched)
        if sensor.fields is not None:
            missed.append(_endpoint_errors(found, real, part))
    distance = np.linalg.norm(np.concatenate(apart), axis=1)
    epe = np.concatenate([np.empty((0, 2)), *missed])
    areas = np.concatenate(area)
    return PairedScore(
        role=role,
        method=method,
        frames=len(packed),
        dice=float(np.concatenate(dice).mean()),
        iou=float(np.concatenate(iou).mean()),
        centroid_px=_quantile(distance, 0.5),
        centroid_p95_px=_quantile(distance, 0.95),
        centroid_mm=_quantile(np.linalg.norm(np.concatenate(apart) * real.mm, axis=1), 0.5),
        count_mismatch=float(np.concatenate(wrong).mean()),
        area_ratio_error=_mean(areas[np.isfinite(areas)]),
        epe_px=_mean(np.linalg.norm(epe, axis=1)),
        epe_mm=_mean(np.linalg.norm(epe * real.mm, axis=1)),
    )


def _endpoint_errors(found: NDArray[np.bool_], real: Real, part: slice) -> Floats:
    sensor, rows = real.sensor, real.rows[part]
    field = sensor.displacement(rows)
    reference = sensor.table["reference"][rows]
    missed = [np.empty((0, 2))]
    for number in np.unique(reference).tolist():
        here = reference == number
        untouched = unpack(sensor.references[number])
        missed.append(
            endpoint_errors(found[here], untouched, field[here], sensor.lattice, real.smallest_px)
        )
    return np.concatenate(missed)


def _mean(values: Floats) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _quantile(values: Floats, share: float) -> float:
    return float(np.quantile(values, share)) if len(values) else float("nan")
