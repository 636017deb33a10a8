"""The paper's figures on forces with their sources, and our values in the same setting."""

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.report import table

Row = Mapping[str, Any]
# Keys of our rows, and words, of the measures.
MEASURES = {
    "fz": ("mae_fz_n", "MAE of Fz [N]"),
    "shear": ("mae_shear_n", "MAE of shear [N]"),
    "r2": ("r2", "R2"),
}
WORDS = {"source-only": "source only", "m2m": "the chain", "plain": "the chain, not compensated"}
# The paper's results on forces: part, method of our rows, measure, statistic of the pairs (or a
# pair, `source:target`), and the value. It gives 5f and 6d in words, as bounds or rounded.
PAPER = (
    ("patterns", "source-only", "fz", "largest", "> 4.8"),
    ("patterns", "source-only", "fz", "smallest", "1.2"),
    ("patterns", "source-only", "shear", "mean", "> 0.28"),
    ("patterns", "source-only", "r2", "mean", "most pairs below 0"),
    ("patterns", "m2m", "fz", "largest", "< 1.0"),
    ("patterns", "m2m", "fz", "smallest", "< 0.7"),
    ("patterns", "m2m", "shear", "largest", "< 0.24"),
    ("patterns", "m2m", "r2", "mean", "> 0.8"),
    ("skins", "plain", "r2", "best and worst from r6", "0.8 and 0.4"),
    ("skins", "plain", "fz", "best and worst from r6", "1 and 2"),
    ("skins", "plain", "r2", "r16:r6", "0.81 (mean of 0.82, 0.82, 0.80)"),
    ("skins", "m2m", "r2", "r6:r8", "-"),
    ("skins", "m2m", "r2", "r6:r18", "-"),
    ("skins", "m2m", "r2", "r16:r6", "0.89 (mean of 0.90, 0.92, 0.85)"),
    ("kinds", "source-only", "fz", "uskin:tacpalm", "10"),
    ("kinds", "source-only", "shear", "uskin:tacpalm", "0.46 (mean of 0.20, 0.72)"),
    ("kinds", "m2m", "fz", "tacpalm:uskin", "1.14, the largest"),
    ("kinds", "m2m", "fz", "uskin:tacpalm", "0.86"),
    ("kinds", "m2m", "fz", "gelsight:tacpalm", "0.57, the smallest"),
    ("kinds", "m2m", "shear", "largest", "< 0.36"),
)


def ours(method: str, measure: str, statistic: str, rows: Sequence[Row]) -> str:
    """Return our value for a figure of the paper; `-` without such a pair."""
    values = {
        f"{row['source']}:{row['target']}": float(row[MEASURES[measure][0]])
        for row in rows
        if row["method"] == method
    }
    if not values:
        return "not measured"
    values |= {"largest": max(values.values()), "smallest": min(values.values())} | {
        "mean": sum(values.values()) / len(values)
    }
    return f"{values[statistic]:.2f}" if statistic in values else "-"


def beside_the_paper(rows: Mapping[str, Sequence[Row]]) -> str:
    """Return the table of the paper's figures, by the rows of each part."""
    lines = [
        [
            f"{part}, {WORDS[method]}: {MEASURES[measure][1]}, {statistic.replace(':', ' to ')}",
            value,
            ours(method, measure, statistic, rows[part]),
        ]
        for part, method, measure, statistic, value in PAPER
        if part in rows
    ]
    return table(["figure", "paper, real sensors", "here, simulated"], lines)
