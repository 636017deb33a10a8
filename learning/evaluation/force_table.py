"""The table of force errors: a row for each pair of sensors, way of training, and role."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from learning.evaluation.predictions import Predictions
from learning.force_errors import AXES, MEASURED, ForceErrors, force_errors

ALL = "all"
"""Role of the row over all held-out frames."""
AXES_NAMED = ("Fx", "Fy", "Fz", "Ft")
"""How axes are called in pictures."""
UNSEEN, SEEN = "new_indenter", "new_press"
"""Roles of frames that no model was trained on: of indenters unseen, and of those seen."""
HELD_OUT = (UNSEEN, SEEN)
BEFORE, TARGET = "source-only", "target"
"""Methods: before anything is transferred, and trained on the target's own labels."""


@dataclass(frozen=True, slots=True)
class ForceRow:
    """Errors of one model on frames of one role."""

    source: str
    """Sensor whose labels the model was trained with."""
    target: str
    """Sensor whose frames these are."""
    method: str
    """How the model was trained, one of `predictions.METHODS`."""
    translator: str
    """What made the images that it was trained on; empty: nothing."""
    role: str
    """Role of the frames in the split; `all`: unseen and seen indenters together."""
    errors: ForceErrors
    """The errors."""
    label_range: tuple[float, float, float, float]
    """Range of Fx, Fy, Fz, Ft of the target's labels [N]."""

    @property
    def variant(self) -> tuple[str, str]:
        """How the model came to be: method and translator."""
        return self.method, self.translator

    def value(self, measure: str) -> float:
        """Return one of `MEASURES`.

        Raises:
            KeyError: No such measure.
        """
        found = dict(zip(MAES, self.errors.mae, strict=True))
        found |= dict(zip(RELATIVES, self.errors.relative, strict=True))
        found |= dict(zip(R2S, self.errors.r2, strict=True))
        found["r2_mean"] = self.errors.r2_mean
        found["mae_shear_n"] = self.errors.shear
        return found[measure]


MAES = tuple(f"mae_{name}_n" for name in MEASURED)
RELATIVES = tuple(f"mae_{name}_over_std" for name in MEASURED)
R2S = tuple(f"r2_{name}" for name in AXES)
MEASURES = (*MAES, *RELATIVES, *R2S, "r2_mean", "mae_shear_n")
"""What a row tells: mean absolute errors [N], the same over the labels' standard deviation, R2 of
each axis and their mean, and the mean of the errors of Fx and Fy [N]."""


def force_rows(predictions: Iterable[Predictions]) -> tuple[ForceRow, ...]:
    """Return the errors by role, and of all held-out frames where several roles are.

    Raises:
        LearningError: Predictions of no frames.
    """
    rows: list[ForceRow] = []
    for one in predictions:
        parts = [(role, one.role == role) for role in _in_order(np.unique(one.role).tolist())]
        held_out = np.isin(one.role, HELD_OUT)
        if held_out.any():
            parts.append((ALL, held_out))
        for role, chosen in parts:
            errors = force_errors(one.true[chosen], one.predicted[chosen], one.label_std)
            low = tuple(one.label_range.tolist())
            rows.append(ForceRow(*one.key, role, errors, (low[0], low[1], low[2], low[3])))
    return tuple(rows)


def of_role(rows: Iterable[ForceRow], role: str) -> tuple[ForceRow, ...]:
    """Return the rows of one role."""
    return tuple(row for row in rows if row.role == role)


def variants(rows: Iterable[ForceRow]) -> tuple[tuple[str, str], ...]:
    """Return the different methods and translators: source-only first, the target's labels last."""
    order = {BEFORE: 0, TARGET: 2}
    found = dict.fromkeys(row.variant for row in rows)
    return tuple(sorted(found, key=lambda variant: order.get(variant[0], 1)))


def variant_name(variant: tuple[str, str]) -> str:
    """Return how a variant is called."""
    method, translator = variant
    return f"{method}, {translator}" if translator else method


def gain_line(rows: Iterable[ForceRow], role: str = UNSEEN) -> str:
    """Return R2 of variants, means over axes and pairs: `source-only R2 a  transferred R2 b`.

    Args:
        rows: Errors of any pairs.
        role: Whose rows are looked at.
    """
    some = of_role(rows, role)
    said = []
    for variant in variants(some):
        values = [row.errors.r2_mean for row in some if row.variant == variant]
        said.append(f"{variant_name(variant)} R2 {np.mean(values):.3f}")
    return "  ".join(said)


def csv_text(lines: Sequence[dict[str, Any]]) -> str:
    """Return a CSV, its columns those of the first line; NaN is left empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(lines[0]), lineterminator="\n")
    writer.writeheader()
    for line in lines:
        writer.writerow({key: _cell(value) for key, value in line.items()})
    return text.getvalue()


def force_line(row: ForceRow) -> dict[str, Any]:
    """Return a row as a line of the CSV."""
    return {
        "source": row.source,
        "target": row.target,
        "method": row.method,
        "translator": row.translator,
        "role": row.role,
        "frames": row.errors.frames,
        **{name: row.value(name) for name in MEASURES},
    }


def _in_order(roles: list[str]) -> list[str]:
    return sorted(roles, key=lambda role: (HELD_OUT.index(role) if role in HELD_OUT else 2, role))


def _cell(value: Any) -> Any:
    if isinstance(value, float):
        return "" if value != value else f"{value:.6g}"
    return value
