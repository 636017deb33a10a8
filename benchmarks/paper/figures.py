"""The paper's figures on forces with their sources, and our values in the same setting.

The paper's forces reach 18 N normal and 4 N shear, ours may not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.report import table

Row = Mapping[str, Any]
_MEASURES = {"fz": "mae_fz_n", "shear": "mae_shear_n", "r2": "r2"}
_WORDS = {"fz": "MAE of Fz [N]", "shear": "MAE of shear [N]", "r2": "R2"}


@dataclass(frozen=True, slots=True)
class Figure:
    """One number of the paper."""

    part: str
    """Part of this benchmark with the same kind of pairs."""
    method: str
    """Method of our rows."""
    measure: str
    """Key of `_MEASURES`."""
    statistic: str
    """`largest`, `smallest` or `mean` of the pairs, or a pair, `source:target`."""
    value: str
    """As the paper gives it, which for some is a bound."""
    source: str


_FIVE, _SIX, _SEVEN = (f"Results, Fig. {number}" for number in ("5d, 5f", "6d, 6f", "7f"))
# The paper's results on forces. It gives 5f and 6d in words, as bounds or rounded.
PAPER = (
    Figure("patterns", "source-only", "fz", "largest", "> 4.8", _FIVE),
    Figure("patterns", "source-only", "shear", "mean", "> 0.28", _FIVE),
    Figure("patterns", "m2m", "fz", "largest", "< 1.0", _FIVE),
    Figure("patterns", "m2m", "shear", "largest", "< 0.24", _FIVE),
    Figure("patterns", "m2m", "r2", "mean", "> 0.8", _FIVE),
    Figure("skins", "m2m", "fz", "largest", "2.0", _SIX),
    Figure("skins", "m2m", "fz", "smallest", "0.6", _SIX),
    Figure("skins", "m2m", "r2", "r16:r6", "0.89 (mean of 0.90, 0.92, 0.85)", _SIX),
    Figure("kinds", "source-only", "fz", "uskin:tacpalm", "10", _SEVEN),
    Figure("kinds", "m2m", "fz", "largest", "1.14", _SEVEN),
    Figure("kinds", "m2m", "shear", "largest", "< 0.36", _SEVEN),
)


def ours(figure: Figure, rows: Sequence[Row]) -> str:
    """Return our value for a figure of the paper; `-` without such a pair."""
    key = _MEASURES[figure.measure]
    values = {
        f"{row['source']}:{row['target']}": float(row[key])
        for row in rows
        if row["method"] == figure.method
    }
    if not values:
        return "-"
    if figure.statistic in ("largest", "smallest"):
        value = (max if figure.statistic == "largest" else min)(values.values())
    elif figure.statistic == "mean":
        value = sum(values.values()) / len(values)
    elif figure.statistic in values:
        value = values[figure.statistic]
    else:
        return "-"
    return f"{value:.2f}"


def beside_the_paper(rows: Mapping[str, Sequence[Row]]) -> str:
    """Return the table of the paper's figures, by the rows of each part."""
    lines = [
        [
            f"{figure.part}, {figure.method}: {_WORDS[figure.measure]}, {figure.statistic}",
            figure.value,
            ours(figure, rows[figure.part]),
            figure.source,
        ]
        for figure in PAPER
        if figure.part in rows
    ]
    return table(["figure", "paper, real sensors", "here, simulated", "place in the paper"], lines)
