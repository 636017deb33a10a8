"""Predicted and true forces, frame by frame, and the table of their errors."""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.compensation.simulated import SIMULATED
from learning.errors import LearningError
from learning.evaluation.results_file import Results, read_results, write_results
from learning.metrics import (
    AXES,
    MEASURED,
    ForceErrors,
    can_be_scored,
    force_errors,
    require_forces,
    spread_and_range,
)
from recorder.archive import ArchivedSensor

KIND = "predictions"
# Training data of the model: the source's images; translated images; these with labels compensated
# by the paper's most frequent choice; by the choice that fits the skins' force-depth curves best;
# by twins of both sensors; by the choice that fits the target's labels best; and the target's own
# labels.
TRANSLATED = ("transferred", "compensated", "priors", SIMULATED, "oracle")
METHODS = ("source-only", *TRANSLATED, "target")
# Those that need no label of the target, in order of the knowledge of the skins that they use.
LABEL_FREE = TRANSLATED[:4]

_TEXTS = ("source", "target", "method", "translator", "model")
_WIDTHS = {"true": 3, "predicted": 3, "label_std": 4, "label_range": 4, "low": 3, "high": 3}
# Missing in old files.
_ADDED = ("low", "high")
_SCALES = ("label_std", "label_range")


@dataclass(frozen=True, slots=True, eq=False)
class Predictions:
    """Forces that one model predicts for frames of one sensor, by location and frame."""

    source: str
    """Sensor whose labels the model was trained with."""
    target: str
    """Sensor of the frames."""
    method: str
    """One of `METHODS`."""
    translator: str
    """Translator of the model's training images; empty if none."""
    model: str
    """Hash of the weights of the force model."""
    rows: NDArray[np.int64]
    """Rows of the archive's table (n,)."""
    location: NDArray[np.int32]
    """Location of each frame (n,)."""
    indenter: NDArray[np.str_]
    """Name of the indenter of each frame (n,)."""
    frame: NDArray[np.int32]
    """Number of each frame within its press (n,)."""
    phase: NDArray[np.int8]
    """Phase code of each frame (n,)."""
    role: NDArray[np.str_]
    """Role of each frame in the split (n,)."""
    true: NDArray[np.float64]
    """Labels (n, 3) [N]; NaN where an axis has none."""
    predicted: NDArray[np.float64]
    """Predicted forces (n, 3) [N]; NaN on axes that the model does not predict."""
    label_std: NDArray[np.float64]
    """Standard deviation of Fx, Fy, Fz, Ft over all labels of the target (4,) [N]; or NaN."""
    label_range: NDArray[np.float64]
    """Range of the same (4,) [N]."""
    low: NDArray[np.float64]
    """Lower ends of 90 % intervals of the predicted forces (n, 3) [N]; NaN without."""
    high: NDArray[np.float64]
    """Upper ends, likewise."""

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise LearningError(f"method: found {self.method!r}; allowed: {', '.join(METHODS)}")
        for field in fields(self):
            if field.name in _TEXTS:
                continue
            values = getattr(self, field.name)
            shape: tuple[int, ...] = () if field.name in _SCALES else (len(self.rows),)
            if field.name in _WIDTHS:
                shape += (_WIDTHS[field.name],)
            if values.shape != shape:
                raise LearningError(
                    f"{field.name}: found shape {values.shape}; allowed: {shape}, as there are "
                    f"{len(self.rows)} rows"
                )
        for name, whole in (("true", False), ("predicted", True)):
            try:
                require_forces(name, getattr(self, name), whole_axes=whole)
            except LearningError as error:
                raise LearningError(f"{self.target}: {error}") from None

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def is_scored(self) -> bool:
        """True if a label can be compared with a prediction."""
        return can_be_scored(self.true, self.predicted)

    @property
    def key(self) -> tuple[str, str, str, str]:
        """Source, target, method and translator."""
        return self.source, self.target, self.method, self.translator

    def only(self, chosen: NDArray[np.bool_]) -> Predictions:
        """Return the chosen frames (n,)."""
        return replace(self, **{name: getattr(self, name)[chosen] for name in _PER_FRAME})

    def write(self, path: Path) -> None:
        """Write the predictions as an .npz."""
        reported = {name: getattr(self, name) for name in _TEXTS}
        arrays = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _TEXTS}
        if np.isnan(self.low).all():
            arrays = {name: array for name, array in arrays.items() if name not in _ADDED}
        write_results(path, Results(KIND, reported, arrays))


def after(methods: Collection[str]) -> str:
    """Return the last of some methods that uses translation and no label of the target."""
    return next((each for each in reversed(LABEL_FREE) if each in methods), LABEL_FREE[0])


_PER_FRAME = tuple(f.name for f in fields(Predictions) if f.name not in (*_TEXTS, *_SCALES))


def predictions_of(
    sensor: ArchivedSensor,
    indenters: Sequence[str],
    rows: NDArray[np.int64],
    role: NDArray[np.str_],
    predicted: NDArray[np.floating[Any]],
    *,
    source: str,
    method: str,
    translator: str,
    model: str,
    interval: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,
) -> Predictions:
    """Combine predicted forces of rows of an archive with the archive's labels, if it has any.

    `indenters` are the archive's by code; rows and roles are (n,), forces (n, 3) [N], and
    `interval` has their lower and upper ends. The others are fields of `Predictions`.
    """
    table = sensor.table
    labels = table["wrench"][:, :3]
    spread, range_ = spread_and_range(labels[table["valid"] & (table["location"] >= 0)])
    low, high = interval or (np.full((len(rows), 3), np.nan),) * 2
    return Predictions(
        source=source,
        target=sensor.name,
        method=method,
        translator=translator,
        model=model,
        rows=np.asarray(rows, np.int64),
        location=table["location"][rows],
        indenter=np.asarray(indenters, np.str_)[table["indenter"][rows]],
        frame=table["frame"][rows],
        phase=table["phase"][rows],
        role=np.asarray(role, np.str_),
        true=labels[rows],
        predicted=np.asarray(predicted, np.float64),
        label_std=spread,
        label_range=range_,
        low=low,
        high=high,
    )


def read_predictions(path: Path) -> Predictions:
    """Read predictions from a file."""
    return predictions_in(read_results(path), path)


def predictions_in(results: Results, path: Path) -> Predictions:
    """Return the predictions in a file's content; `path` is for error messages."""
    if results.kind != KIND:
        raise LearningError(f"{path}: found {results.kind}; allowed: {KIND}")
    wanted = {f.name for f in fields(Predictions)}
    content = {**results.reported, **results.arrays}
    if "predicted" in content:
        without = np.full_like(content["predicted"], np.nan)
        content = {**dict.fromkeys(_ADDED, without), **content}
    if set(content) != wanted:
        different = ", ".join(sorted(set(content) ^ wanted))
        raise LearningError(f"{path}: missing or unexpected: {different}")
    try:
        return Predictions(**content)
    except LearningError as error:
        raise LearningError(f"{path}: {error}") from None


def merged(predictions: Iterable[Predictions]) -> tuple[Predictions, ...]:
    """Merge predictions with the same source, target, method and translator."""
    groups: dict[tuple[str, str, str, str], list[Predictions]] = {}
    for one in predictions:
        groups.setdefault(one.key, []).append(one)
    return tuple(_joined(parts) for parts in groups.values())


def _joined(parts: list[Predictions]) -> Predictions:
    first = parts[0]
    if len(parts) == 1:
        return first
    name = f"{first.source} to {first.target}, {first.method} {first.translator}".rstrip()
    models = sorted({one.model for one in parts})
    if len(models) > 1:
        raise LearningError(f"{name}: found models {', '.join(models)}; allowed: one")
    rows = np.concatenate([one.rows for one in parts])
    frames, count = np.unique(rows, return_counts=True)
    if count.max(initial=1) > 1:
        twice = frames[count > 1][0]
        raise LearningError(f"{name}: found row {twice} twice; allowed: each frame once")
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(one, name) for one in parts]) for name in _PER_FRAME
    }
    return replace(first, **joined)


# The table of force errors: a row for each pair of sensors, training method, and role.

# Role of the row over all held-out frames.
ALL = "all"
# Names of axes in plots.
AXES_NAMED = ("Fx", "Fy", "Fz", "Ft")
# Roles of frames that no model was trained on: of unseen indenters, and of seen ones.
UNSEEN, SEEN = "new_indenter", "new_press"
HELD_OUT = (UNSEEN, SEEN)
# Methods: without transfer, and trained on the target's own labels.
BEFORE, TARGET = "source-only", "target"


@dataclass(frozen=True, slots=True)
class ForceRow:
    """Errors of one model on frames of one role."""

    source: str
    """Sensor whose labels the model was trained with."""
    target: str
    """Sensor of the frames."""
    method: str
    """Training method of the model, one of `METHODS`."""
    translator: str
    """Translator of its training images; empty if none."""
    role: str
    """Role of the frames in the split; `all`: unseen and seen indenters together."""
    errors: ForceErrors
    label_range: tuple[float, ...]
    """Range of Fx, Fy, Fz, Ft of the target's labels [N]."""

    @property
    def variant(self) -> tuple[str, str]:
        """Method and translator of the model."""
        return self.method, self.translator

    def value(self, measure: str) -> float:
        """Return one of `MEASURES`."""
        errors = self.errors
        values = *errors.mae, *errors.relative, *errors.r2, errors.r2_mean, errors.shear
        return dict(zip(MEASURES, values, strict=True))[measure]


MAES = tuple(f"mae_{name}_n" for name in MEASURED)
RELATIVES = tuple(f"mae_{name}_over_std" for name in MEASURED)
R2S = tuple(f"r2_{name}" for name in AXES)
# Measures of a row: mean absolute errors [N], the same over the labels' standard deviation, R2 of
# each axis and their mean, and the mean of the errors of Fx and Fy [N].
MEASURES = (*MAES, *RELATIVES, *R2S, "r2_mean", "mae_shear_n")


def force_rows(predictions: Iterable[Predictions]) -> tuple[ForceRow, ...]:
    """Return the errors by role, and over all held-out frames; without labels there is no row."""
    rows: list[ForceRow] = []
    for one in predictions:
        others = sorted(set(one.role.tolist()) - set(HELD_OUT))
        roles = [role for role in (*HELD_OUT, *others) if role in one.role]
        parts = [(role, one.role == role) for role in roles]
        held_out = np.isin(one.role, HELD_OUT)
        if held_out.any():
            parts.append((ALL, held_out))
        for role, chosen in parts:
            if not can_be_scored(one.true[chosen], one.predicted[chosen]):
                continue
            errors = force_errors(one.true[chosen], one.predicted[chosen], one.label_std)
            rows.append(ForceRow(*one.key, role, errors, tuple(one.label_range.tolist())))
    return tuple(rows)


def unscored_lines(predictions: Iterable[Predictions]) -> list[dict[str, Any]]:
    """Return a line for each axis of predictions without a label to compare with.

    A line has the keys source, target, method, translator, axis, frames, low_n and high_n: the
    least and the largest predicted force [N].
    """
    lines = []
    for one in predictions:
        for column, axis in enumerate(AXES_NAMED[: len(AXES)]):
            forces = one.predicted[:, column]
            if not np.isfinite(forces).any() or np.isfinite(one.true[:, column]).any():
                continue
            named = dict(zip(("source", "target", "method", "translator"), one.key, strict=True))
            span = {"low_n": float(forces.min()), "high_n": float(forces.max())}
            lines.append({**named, "axis": axis, "frames": len(one), **span})
    return lines


def of_role(rows: Iterable[ForceRow], role: str) -> tuple[ForceRow, ...]:
    """Return the rows of one role."""
    return tuple(row for row in rows if row.role == role)


def variants(rows: Iterable[ForceRow]) -> tuple[tuple[str, str], ...]:
    """Return the distinct methods and translators: source-only first, the target's labels last."""
    order = {BEFORE: 0, TARGET: 2}
    distinct = dict.fromkeys(row.variant for row in rows)
    return tuple(sorted(distinct, key=lambda variant: order.get(variant[0], 1)))


def variant_name(variant: tuple[str, str]) -> str:
    """Return the name of a variant."""
    method, translator = variant
    return f"{method}, {translator}" if translator else method


def gain_line(rows: Iterable[ForceRow], role: str = UNSEEN) -> str:
    """Return R2 of variants, means over axes and pairs of a role: `source-only R2 a  ...`."""
    some = of_role(rows, role)
    reported = []
    for variant in variants(some):
        rows_of = [row for row in some if row.variant == variant]
        mean = np.mean([row.errors.r2_mean for row in rows_of])
        of = "".join(dict.fromkeys(row.errors.of_axes for row in rows_of))
        reported.append(f"{variant_name(variant)} R2 {mean:.3f}{of}")
    return "  ".join(reported)


def csv_text(lines: Sequence[dict[str, Any]]) -> str:
    """Return a CSV with the columns of the first line; NaN is left empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(lines[0]), lineterminator="\n")
    writer.writeheader()
    for line in lines:
        writer.writerow({key: _cell(value) for key, value in line.items()})
    return text.getvalue()


def force_line(row: ForceRow) -> dict[str, Any]:
    """Return a row as a line of the CSV."""
    return {
        **{name: getattr(row, name) for name in ("source", "target", "method", "translator")},
        "role": row.role,
        "frames": row.errors.frames,
        **{name: row.value(name) for name in MEASURES},
    }


def _cell(value: Any) -> Any:
    if isinstance(value, float):
        return "" if value != value else f"{value:.6g}"
    return value
