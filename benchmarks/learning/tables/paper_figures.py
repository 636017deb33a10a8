"""The paper's figures with their sources, and our values in the same setting.

The paper's forces reach 18 N normal and 4 N shear, ours may not. So errors are given in newtons and
as a fraction of the range of the labels (the paper: 18 N normal, 8 N shear, Results).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from learning.evaluation.predictions import ALL, UNSEEN, ForceRow, of_role
from learning.metrics import AXES

# The paper's sensors by test; the material test from hard to soft.
GROUPS = {
    "homogeneous": ("array-i", "array-ii", "circle-i", "circle-ii", "diamond-i"),
    "material": ("r6", "r8", "r10", "r12", "r14", "r16", "r18"),
    "heterogeneous": ("uskin", "gelsight", "tacpalm"),
}
# Range of the paper's forces [N]: 0 to 18 and -4 to 4 (the paper, Results).
NORMAL_RANGE, SHEAR_RANGE = 18.0, 8.0
# Axes normal to the skin and along it.
NORMAL, SHEAR = ("fz",), ("fx", "fy")


@dataclass(frozen=True, slots=True)
class PaperFigure:
    """One number of the paper."""

    group: str
    """Test: a key of `GROUPS`."""
    method: str
    """`source-only`, `transferred` or `compensated`."""
    measure: str
    """Name of the measure.

    `fx`, `fy`, `fz`: mean absolute error [N]; `shear`: of Fx and Fy; `r2_fx` and so on: R2; `r2`:
    over all axes.
    """
    statistic: str
    """`max`, `min` or `mean` over pairs; `pair`: of the named pair."""
    value: float
    """Value in the paper."""
    cited: str
    """Place in the paper."""
    relation: str = ""
    """`>` or `<` if the paper only gives a bound."""
    pair: tuple[str, str] | None = None
    """Source and target, if named."""
    which: str = ""
    """Pairs: `harder` or `softer` target; `others`: all but uSkin to GelSight and TacPalm."""


_FIVE, _SIX, _SEVEN = (f"Results, Fig. {number}" for number in ("5d, 5f", "6d, 6f", "7f"))
_H, _M, _X = "homogeneous", "material", "heterogeneous"
_SO, _TR, _CO = "source-only", "transferred", "compensated"

# The paper's results on forces. It gives 5f and 6d in words, as bounds or rounded.
PAPER = (
    PaperFigure(_H, _SO, "fz", "max", 4.8, _FIVE, ">", ("circle-ii", "diamond-i")),
    PaperFigure(_H, _SO, "fz", "min", 1.2, _FIVE, "", ("array-i", "circle-i")),
    PaperFigure(_H, _SO, "shear", "mean", 0.28, _FIVE, ">"),
    PaperFigure(_H, _SO, "fx", "max", 0.56, _FIVE, "", ("array-ii", "circle-ii")),
    PaperFigure(_H, _SO, "fy", "max", 0.56, _FIVE, "", ("array-ii", "array-i")),
    PaperFigure(_H, _SO, "shear", "min", 0.14, _FIVE, ">"),
    PaperFigure(_H, _TR, "fz", "max", 1.0, _FIVE, "<", ("diamond-i", "array-i")),
    PaperFigure(_H, _TR, "fz", "min", 0.7, _FIVE, "<", ("array-i", "circle-ii")),
    PaperFigure(_H, _TR, "fz", "pair", 0.96, _FIVE, "", ("circle-ii", "diamond-i")),
    PaperFigure(_H, _TR, "shear", "max", 0.24, _FIVE, "<"),
    PaperFigure(_H, _TR, "shear", "min", 0.06, _FIVE, "<"),
    PaperFigure(_H, _TR, "r2", "mean", 0.8, _FIVE, ">"),
    PaperFigure(_M, _TR, "fz", "max", 2.0, _SIX, which="softer"),
    PaperFigure(_M, _TR, "fz", "max", 1.1, _SIX, which="harder"),
    PaperFigure(_M, _TR, "fz", "min", 0.6, _SIX, which="harder"),
    PaperFigure(_M, _TR, "shear", "max", 0.25, _SIX, "<", which="harder"),
    PaperFigure(_M, _TR, "r2", "mean", 0.8, _SIX, ">", which="harder"),
    PaperFigure(_M, _TR, "r2_fx", "pair", 0.82, _SIX, "", ("r16", "r6")),
    PaperFigure(_M, _TR, "r2_fy", "pair", 0.82, _SIX, "", ("r16", "r6")),
    PaperFigure(_M, _TR, "r2_fz", "pair", 0.80, _SIX, "", ("r16", "r6")),
    PaperFigure(_M, _CO, "r2_fx", "pair", 0.90, _SIX, "", ("r16", "r6")),
    PaperFigure(_M, _CO, "r2_fy", "pair", 0.92, _SIX, "", ("r16", "r6")),
    PaperFigure(_M, _CO, "r2_fz", "pair", 0.85, _SIX, "", ("r16", "r6")),
    PaperFigure(_X, _SO, "fz", "pair", 10.0, _SEVEN, "", ("uskin", "tacpalm")),
    PaperFigure(_X, _SO, "fy", "pair", 0.72, _SEVEN, "", ("uskin", "tacpalm")),
    PaperFigure(_X, _SO, "fx", "pair", 0.2, _SEVEN, "", ("uskin", "tacpalm")),
    PaperFigure(_X, _SO, "fz", "mean", 2.29, _SEVEN, which="others"),
    PaperFigure(_X, _SO, "shear", "mean", 0.36, _SEVEN, which="others"),
    PaperFigure(_X, _TR, "fz", "max", 1.14, _SEVEN, "", ("tacpalm", "uskin")),
    PaperFigure(_X, _TR, "fz", "min", 0.57, _SEVEN, "", ("gelsight", "tacpalm")),
    PaperFigure(_X, _TR, "fz", "pair", 0.86, _SEVEN, "", ("uskin", "tacpalm")),
    PaperFigure(_X, _TR, "fy", "pair", 0.18, _SEVEN, "", ("uskin", "tacpalm")),
    PaperFigure(_X, _TR, "fy", "max", 0.36, _SEVEN, "<"),
    PaperFigure(_X, _TR, "fx", "max", 0.27, _SEVEN, "<"),
)


@dataclass(frozen=True, slots=True)
class Beside:
    """One figure of the paper, and our value."""

    figure: PaperFigure
    """The paper's."""
    translator: str
    """Our translator; empty if none is used."""
    pairs: int
    """Number of our pairs."""
    of: int
    """Number of the paper's pairs."""
    held_out: float
    """Our value over all held-out frames; NaN if there are none."""
    unseen: float
    """Our value over unseen indenters alone; NaN if there are none."""
    paper_share: float
    """The paper's value over the range of its labels; NaN for R2."""
    our_share: float
    """Our value over all held-out frames, over the range of our labels; NaN for R2."""


def group_of(source: str, target: str) -> str | None:
    """Return the paper's test that a pair of sensors belongs to."""
    for group, sensors in GROUPS.items():
        if source != target and {source.lower(), target.lower()} <= set(sensors):
            return group
    return None


def beside_the_paper(rows: Sequence[ForceRow]) -> tuple[Beside, ...]:
    """Return the paper's figures for which we have pairs of the same test, with our values."""
    found: list[Beside] = []
    for figure in PAPER:
        of_ours = [row for row in rows if row.method == figure.method and _belongs(row, figure)]
        for translator in dict.fromkeys(row.translator for row in of_ours):
            ours = [row for row in of_ours if row.translator == translator]
            held_out, unseen = of_role(ours, ALL), of_role(ours, UNSEEN)
            found.append(
                Beside(
                    figure,
                    translator,
                    len(held_out or unseen),
                    _paired(figure),
                    _statistic(held_out, figure),
                    _statistic(unseen, figure),
                    paper_share(figure),
                    _statistic(held_out, figure, fraction=True),
                )
            )
    return tuple(found)


def _belongs(row: ForceRow, figure: PaperFigure) -> bool:
    source, target = row.source.lower(), row.target.lower()
    if group_of(source, target) != figure.group:
        return False
    if figure.statistic == "pair":
        return (source, target) == figure.pair
    return _chosen(source, target, figure)


def _chosen(source: str, target: str, figure: PaperFigure) -> bool:
    sensors = GROUPS[figure.group]
    softer = sensors.index(target) > sensors.index(source)
    # The paper treats the two pairs from uSkin separately from "the remaining four".
    wanted = {"": True, "softer": softer, "harder": not softer, "others": source != "uskin"}
    return wanted[figure.which]


def _paired(figure: PaperFigure) -> int:
    if figure.statistic == "pair":
        return 1
    sensors = GROUPS[figure.group]
    return sum(_chosen(a, b, figure) for a in sensors for b in sensors if a != b)


def _statistic(rows: Sequence[ForceRow], figure: PaperFigure, *, fraction: bool = False) -> float:
    values = [_value(row, figure.measure, fraction) for row in rows]
    values = [value for value in values if not math.isnan(value)]  # axes without labels
    if not values:
        return math.nan
    if figure.statistic == "max":
        return max(values)
    return min(values) if figure.statistic == "min" else sum(values) / len(values)


def _value(row: ForceRow, measure: str, fraction: bool) -> float:
    if measure.startswith("r2"):
        if fraction:
            return math.nan
        return row.errors.r2_mean if measure == "r2" else row.value(measure)
    axes = SHEAR if measure == "shear" else (measure,)
    if fraction:
        return label_share(row, axes)
    return sum(row.errors.mae[AXES.index(axis)] for axis in axes) / len(axes)


def label_share(row: ForceRow, axes: Sequence[str]) -> float:
    """Return our mean absolute error over the range of the labels, as a mean over axes.

    Args:
        row: The errors.
        axes: Some of `fx`, `fy`, `fz`.
    """
    places = [AXES.index(axis) for axis in axes]
    return sum(row.errors.mae[place] / row.label_range[place] for place in places) / len(axes)


def paper_share(figure: PaperFigure) -> float:
    """Return the paper's error over the range of its labels; NaN for R2."""
    if figure.measure.startswith("r2"):
        return math.nan
    return figure.value / (NORMAL_RANGE if figure.measure == "fz" else SHEAR_RANGE)


def beside_line(one: Beside) -> dict[str, Any]:
    """Return a figure of the paper and our value as a line of the CSV."""
    figure = asdict(one.figure)
    figure["pair"] = " to ".join(one.figure.pair) if one.figure.pair else ""
    ours = {key: value for key, value in asdict(one).items() if key != "figure"}
    return {**figure, **ours}
