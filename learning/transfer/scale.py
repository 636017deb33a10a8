"""Scale of a model: by weights that were laid on the sensor, or a few labelled presses."""

import csv
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from learning.data.labels import Labels
from learning.errors import LearningError
from learning.force.calibrate import presses_of_rows
from learning.force.intervals import Intervals, Scale, ScaleSample, measured_scale, read_intervals
from learning.force.loading import load_force_model
from learning.force.model import ForceModel
from learning.transfer.deliver import learned_indenters, rescale, scale_line
from recorder.archive import ArchivedSensor, MarkerArchive

Floats = NDArray[np.float64]

# By weights on a delivered model.

# A hold is settled in its second half, if its force varies there by less than this fraction.
SETTLED = 0.1
# Shortest hold [frames]; shorter contacts are touches of a hand.
SHORTEST = 10
# Frames without contact within a hold that do not end it.
_GAP = 5


def weigh(
    model_folder: Path, out: Path, weights: Sequence[float], predicted: Sequence[float]
) -> Iterator[str]:
    """Write the model with the scale that weights give, and yield what is then known of it.

    Weights and the Fz predicted under each are in [N]; the model is one that `tactile force`
    made.
    """
    intervals = read_intervals(model_folder)
    if intervals is None or intervals.axes[2] is None:
        raise LearningError(
            f"{model_folder}: found no interval of Fz; allowed: a model of `tactile force`"
        )
    if len(weights) != len(predicted):
        raise LearningError(
            f"--weights: found {len(weights)}, and {len(predicted)} forces; allowed: one each"
        )
    learned_indenters(model_folder)
    if intervals.scale.factor == 1.0:
        raise LearningError(
            f"{model_folder}: learned from {intervals.errors_from}, whose scale weights cannot "
            "change; allowed: a model by --by source or --by twin"
        )
    axis = intervals.axes[2]
    samples = [
        ScaleSample(-weight, force, axis.base + axis.slope * abs(force))
        for weight, force in zip(weights, predicted, strict=True)
    ]
    listed = ", ".join(f"{weight:.3f}" for weight in weights)
    text = f"weights laid on the sensor: {listed} N"
    value, scale = measured_scale(samples, intervals.scale, text)
    for one in samples:
        yield f"weight {-one.true:.3f} N: predicted {-one.predicted:.3f} N before"
    scale = replace(scale, source=f"{text}: factor {value:.3f}")
    rescale(model_folder, out, value, intervals.rescaled(value, scale))
    yield f"factor {value:.3f}"
    yield scale_line(scale)
    if scale.factor > 0.8 * (intervals.scale.factor - 1.0) + 1.0:
        yield (
            "the weights hardly narrow the scale: they are light beside the model's error of "
            f"{axis.base:.3f} N; heavier ones tell more"
        )
    yield f"{out}: written"


def forces_of_holds(path: Path, count: int) -> list[float]:
    """Return the settled Fz of each hold in the forces that `tactile live --out` wrote [N]."""
    force, contact = _read(path)
    holds = [span for span in _spans(contact) if span[1] - span[0] >= SHORTEST]
    if len(holds) != count:
        listed = ", ".join(f"{end - begin} frames" for begin, end in holds) or "none"
        raise LearningError(
            f"{path}: found {len(holds)} holds ({listed}); allowed: {count}, one for each weight, "
            "each lifted off before the next"
        )
    forces = []
    for number, (begin, end) in enumerate(holds, 1):
        half = force[begin + (end - begin) // 2 : end]
        # The hand that lifts a weight off is in the last tenth.
        half = half[: max(3, len(half) - (end - begin) // 10)]
        middle = float(np.median(half))
        low, high = np.quantile(half, (0.05, 0.95))
        if high - low > SETTLED * abs(middle):
            raise LearningError(
                f"{path}: hold {number} varies from {low:.3f} to {high:.3f} N in its second half; "
                f"allowed: {100 * SETTLED:.0f} % of its {middle:.3f} N; let each weight rest for "
                "seconds"
            )
        forces.append(middle)
    return forces


def forces_of_rows(model_folder: Path, named: str, rows: Sequence[int]) -> list[float]:
    """Return the Fz that a model predicts in some rows of an archive [N]."""
    path, _, sensor_name = named.rpartition(":")
    archive = MarkerArchive(path)
    if sensor_name not in archive:
        raise LearningError(
            f"--archive: found no sensor {sensor_name!r} in {path}; allowed: {', '.join(archive)}"
        )
    sensor, model = archive[sensor_name], load_force_model(model_folder)
    table = sensor.table
    for row in rows:
        if not 0 <= row < len(sensor) or not table["valid"][row]:
            raise LearningError(f"--rows: found {row}; allowed: valid rows, 0 to {len(sensor) - 1}")
    fz: list[float] = forces_at(sensor, rows, model)[:, 2].tolist()
    return fz


def forces_at(
    sensor: ArchivedSensor, rows: Sequence[int] | NDArray[np.int64], model: ForceModel
) -> Floats:
    """Return the forces that a model predicts in some rows (n, 3) [N], from their whole presses."""
    table = sensor.table
    keys = np.stack([table[name] for name in ("location", "indenter", "target")], axis=1)
    pressed = np.unique(keys[rows], axis=0)
    whole = (keys[:, None] == pressed[None]).all(axis=-1).any(axis=1) & table["valid"]
    presses = presses_of_rows(sensor, np.flatnonzero(whole), model)
    order = {row: index for index, row in enumerate(presses.rows.tolist())}
    return model.predict(presses)[[order[int(row)] for row in rows]]


def _read(path: Path) -> tuple[Floats, NDArray[np.bool_]]:
    """Return Fz (n,) [N] and contact (n,)."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            lines = list(csv.DictReader(file))
        force = np.array([float(line["Fz_N"]) for line in lines])
        contact = np.array([int(line["contact"]) for line in lines], np.bool_)
    except (OSError, UnicodeDecodeError) as error:
        raise LearningError(f"{path}: cannot be read: {error}") from None
    except (KeyError, TypeError, ValueError) as error:
        raise LearningError(
            f"{path}: {error!r}; allowed: the columns Fz_N and contact, as `tactile live --out` "
            "writes them"
        ) from None
    if not np.isfinite(force).all():
        raise LearningError(f"{path}: found no Fz in some lines; allowed: a model of Fz")
    return force, contact


def _spans(contact: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return first and last + 1 frame of each contact, joined across short gaps."""
    edges = np.flatnonzero(np.diff(np.r_[0, contact.astype(np.int8), 0]))
    spans: list[tuple[int, int]] = []
    for begin, end in edges.reshape(-1, 2).tolist():
        if spans and begin - spans[-1][1] < _GAP:
            spans[-1] = spans[-1][0], end
        else:
            spans.append((begin, end))
    return spans


# By a few labelled presses of the target, which measure the error as well.

# Labelled presses of an axis from which it has a gain of its own, as shear and pressing may
# differ; below, all axes have the same. Offsets are not corrected: they would show without contact.
GAINS_FROM = 5
# Largest ratio of an axis's gain and the common one.
_GAIN_MOST = 2.0


def scaled_by_labels(model_folder: Path, out: Path, labels: Labels, sensor: ArchivedSensor) -> str:
    """Write a model with the scale that a few labels of its sensor give; return a line about it."""
    intervals = read_intervals(model_folder)
    assert intervals is not None
    predicted = forces_at(sensor, labels.rows, load_force_model(model_folder))
    gains, scale, text = gains_of_labels(labels, predicted, intervals)
    scale = replace(scale, source=text)
    rescale(model_folder, out, gains.tolist(), intervals.rescaled(gains.tolist(), scale))
    return scale_line(scale)


def gains_of_labels(
    labels: Labels, predicted: Floats, intervals: Intervals
) -> tuple[Floats, Scale, str]:
    """Return factors (3,) on forces predicted at labels (n, 3) [N], uncertainty, a sentence."""
    text = f"scale from {labels.presses} labelled presses of the target"
    gains, scale = _gains(labels, predicted, intervals, labels.presses, text)
    listed = ", ".join(f"{gain:.3f}" for gain in gains)
    factors = f"factors of Fx, Fy, Fz {listed}" if np.ptp(gains) else f"factor {gains[0]:.3f}"
    return gains, scale, f"{text}: {factors}"


def _gains(
    labels: Labels, predicted: Floats, intervals: Intervals, presses: int, source: str
) -> tuple[Floats, Scale]:
    """Return the factor of each axis by the first presses: with few of them, the common one."""
    value, scale = _scale(labels, predicted, intervals, presses, source)
    gains = np.full(3, value)
    for axis in range(3):
        labelled = np.isfinite(labels.forces[:, axis]) & np.isfinite(predicted[:, axis])
        labelled &= labels.press < presses
        if len(np.unique(labels.press[labelled])) < GAINS_FROM:
            continue
        x, y = value * predicted[labelled, axis], labels.forces[labelled, axis]
        gain = float((x * y).sum()) / max(float((x**2).sum()), 1e-12)
        gains[axis] *= min(max(gain, 1 / _GAIN_MOST), _GAIN_MOST)
    return gains, scale


def _scale(
    labels: Labels, predicted: Floats, intervals: Intervals, presses: int, source: str
) -> tuple[float, Scale]:
    """Return the scale by the strongest labelled force of each of the first presses."""
    samples: list[ScaleSample] = []
    low, high = intervals.rescaled(1.0, Scale(1.0, "", False)).of(predicted)
    error = 0.5 * (high - low)
    for press in range(presses):
        rows = np.flatnonzero(labels.press == press)
        size = np.abs(np.where(np.isfinite(error[rows]), labels.forces[rows], np.nan))
        if np.isnan(size).all():
            continue
        index, axis = divmod(int(np.nanargmax(size)), 3)
        row = rows[index]
        known = (float(each[row, axis]) for each in (labels.forces, predicted, error))
        samples.append(ScaleSample(*known))
    return measured_scale(samples, intervals.scale, source, independent=len(samples))
