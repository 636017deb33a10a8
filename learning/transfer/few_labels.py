"""Optional stage: a few labelled presses of the target set the scale, and measure the error.

The file is a CSV with the columns `indenter`, `target`, `frame` (as in the target's own archive)
and `fx_n`, `fy_n`, `fz_n` [N]; an empty force, or a column that is not there, is not measured.
Readings that were typed in have no frame: without one, a force is that at the end of the pressing,
where a press is held.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from learning.force.intervals import Held, Intervals, Scale, measured_scale
from learning.metrics import force_errors, spread_and_range
from recorder import MarkerArchive
from recorder.spec import PHASES

Floats = NDArray[np.float64]

KEYS, FORCES = ("indenter", "target"), ("fx_n", "fy_n", "fz_n")
FRAME = "frame"
_PRESSING = PHASES.index("normal_inc")
# Numbers of labelled presses whose errors the report lists.
COUNTS = (0, 1, 5, 20, 100)
# Labelled presses of an axis from which it has a gain of its own, as shear and pressing may
# differ; below, all axes have the same. Offsets are not corrected: they would show without contact.
GAINS_FROM = 5
# Largest ratio of an axis's gain and the common one.
_GAIN_MOST = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Labels:
    """Labels of a few frames of the target, in the order of their presses."""

    rows: NDArray[np.int64]
    """Rows of the target's table (n,)."""
    forces: Floats
    """Fx, Fy, Fz (n, 3) [N]; NaN is not measured."""
    press: NDArray[np.int64]
    """Number of the press of each, 0 and up (n,)."""

    @property
    def presses(self) -> int:
        """Number of labelled presses."""
        return int(self.press.max()) + 1


def read_labels(path: Path, archive: MarkerArchive, sensor: str) -> Labels:
    """Read the labels of a target's frames.

    Raises:
        LearningError: A column is missing, a number is none, or a frame is unknown or named twice.
    """
    table = archive[sensor].table
    names = archive.indenters
    known = {
        (names[code], int(target), int(frame)): row
        for row, (code, target, frame) in enumerate(
            zip(table["indenter"], table["target"], table["frame"], strict=True)
        )
        if table["valid"][row]
    }
    held = {
        key[:2]: key[2] for key, row in sorted(known.items()) if table["phase"][row] == _PRESSING
    }
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            columns = set(reader.fieldnames or ())
            if (missing := set(KEYS) - columns) or not columns & set(FORCES):
                lacking = ", ".join(sorted(missing)) or "a column of forces"
                raise LearningError(
                    f"{path}: missing {lacking}; allowed: the columns {', '.join(KEYS)}, "
                    f"{FRAME} (none: where the press is held), and some of {', '.join(FORCES)}"
                )
            lines = list(reader)
    except (OSError, UnicodeDecodeError) as error:
        raise LearningError(f"{path}: cannot be read: {error}") from None
    found: dict[int, list[float]] = {}
    pressed: dict[tuple[str, int], int] = {}
    numbers: list[int] = []
    for number, line in enumerate(lines, 2):
        where = f"{path}, line {number}"
        try:
            press = line["indenter"], int(line["target"])
            frame = line.get(FRAME, "").strip()
            key = *press, int(frame) if frame else held.get(press, -1)
            texts = [line.get(name, "").strip() for name in FORCES]
            forces = [float(text) if text else math.nan for text in texts]
        except (TypeError, ValueError, AttributeError) as error:
            raise LearningError(f"{where}: {error}; allowed: numbers, or no force") from None
        if math.inf in map(abs, forces):
            raise LearningError(f"{where}: found an infinite force; allowed: numbers, or none")
        if key not in known:
            named = f"frame {frame}" if frame else "frame where it is held"
            raise LearningError(f"{where}: {sensor} has no {named} of target {key[1]} of {key[0]}")
        if known[key] in found:
            raise LearningError(f"{where}: found frame {key} twice; allowed: once")
        found[known[key]] = forces
        numbers.append(pressed.setdefault(press, len(pressed)))
    if not found or np.isnan(list(found.values())).all():
        raise LearningError(f"{path}: found no force; allowed: one or more")
    return Labels(np.array(list(found)), np.array(list(found.values())), np.array(numbers))


def gains_of_labels(
    labels: Labels, predicted: Floats, intervals: Intervals
) -> tuple[Floats, Scale, str]:
    """Return factors on predicted forces (3,), their remaining uncertainty, and a sentence.

    Args:
        labels: Labels of the target.
        predicted: Forces predicted there (n, 3) [N].
        intervals: Intervals of the model.

    Raises:
        LearningError: The labels' forces are of another sign than the predicted ones.
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
