"""Scale of a delivered model from weights that were laid on the sensor."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from learning.force.intervals import Held, measured_scale, read_intervals
from learning.force.model import load_force_model
from learning.transfer.calibrate import forces_at
from learning.transfer.deliver import deliver, lines_of, read_card
from recorder import MarkerArchive

Floats = NDArray[np.float64]

# A hold is settled in its second half, if its force varies there by less than this fraction.
SETTLED = 0.1
# Shortest hold [frames]; shorter contacts are touches of a hand.
SHORTEST = 10
# Frames without contact within a hold that do not end it.
_GAP = 5


def weigh(
    model_folder: Path, out: Path, known: Sequence[float], predicted: Sequence[float]
) -> Iterator[str]:
    """Write the model with the scale that weights give, and yield what is then known of it.

    Args:
        model_folder: A model that `tactile transfer` made.
        out: Folder to write.
        known: Weights [N].
        predicted: Fz that the model predicts under each [N].
    """
    intervals = read_intervals(model_folder)
    if intervals is None or intervals.axes[2] is None:
        raise LearningError(
            f"{model_folder}: found no interval of Fz; allowed: RUN/model of `tactile transfer`"
        )
    if len(known) != len(predicted):
        raise LearningError(
            f"--weights: found {len(known)}, and {len(predicted)} forces; allowed: one each"
        )
    card = read_card(model_folder, intervals)
    axis = intervals.axes[2]
    held = [
        Held(-weight, force, axis.base + axis.slope * abs(force))
        for weight, force in zip(known, predicted, strict=True)
    ]
    listed = ", ".join(f"{weight:.3f}" for weight in known)
    text = f"weights laid on the sensor: {listed} N"
    value, scale = measured_scale(held, intervals.scale, text)
    for one in held:
        yield f"weight {-one.known:.3f} N: predicted {-one.predicted:.3f} N before"
    done = replace(
        card,
        intervals=intervals.rescaled(value, scale),
        history=(*card.history, f"{text}: factor {value:.3f}"),
    )
    deliver(model_folder, out, done, value)
    yield f"factor {value:.3f}"
    yield from lines_of(done)
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
    found = []
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
        found.append(middle)
    return found


def forces_of_rows(model_folder: Path, named: str, rows: Sequence[int]) -> list[float]:
    """Return the Fz that a model predicts in some rows of an archive [N]."""
    where, _, sensor_name = named.rpartition(":")
    archive = MarkerArchive(where)
    if sensor_name not in archive:
        raise LearningError(
            f"--archive: found no sensor {sensor_name!r} in {where}; allowed: {', '.join(archive)}"
        )
    sensor, model = archive[sensor_name], load_force_model(model_folder)
    table = sensor.table
    for row in rows:
        if not 0 <= row < len(sensor) or not table["valid"][row]:
            raise LearningError(f"--rows: found {row}; allowed: valid rows, 0 to {len(sensor) - 1}")
    fz: list[float] = forces_at(sensor, rows, model)[:, 2].tolist()
    return fz


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
