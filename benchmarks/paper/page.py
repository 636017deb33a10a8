"""Sections of the page: forces of each part, patterns, and the paper's figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.paper.chain import OWN
from benchmarks.paper.figures import beside_the_paper
from benchmarks.report import Page, table
from learning.evaluation.translation import NEAREST
from recorder.charts import chart
from recorder.natural_order import natural_key

Row = Mapping[str, Any]
# Rows of the tables of forces, and their words.
METHODS = {
    "source-only": "source only: its net as it is",
    NEAREST: "nearest frame: the label of the most similar location pair",
    "displacement": "displacement: a net of marker displacement, no translator",
    "field": "our `field` translator, then the net",
    "m2m": "**the paper's chain: M2M, then the net**",
    OWN: "own labels",
}
TITLES = {
    "patterns": "Between patterns on one skin",
    "skins": "Between skins",
    "kinds": "Between kinds of sensors",
}


def by_held_out(
    rows: Iterable[Row], held_out: Sequence[str], ends: Sequence[str]
) -> tuple[list[Row], list[Row]]:
    """Return the rows whose sensors or patterns were trained on, and the others."""
    parted: tuple[list[Row], list[Row]] = ([], [])
    for row in rows:
        parted[any(row[end] in held_out for end in ends)].append(row)
    return parted


def mean(rows: Iterable[Row], key: str, digits: int = 3) -> str:
    """Return the mean of a column; `-` without rows."""
    values = [float(row[key]) for row in rows]
    return f"{np.mean(values):.{digits}f}" if values else "-"


def r2(values: Mapping[str, Any], method: str) -> str:
    """Return the mean R2 of a method over the pairs whose target was trained on.

    That of own labels is by the net of the chain.
    """
    rows, _ = by_held_out(values["forces"], values["held out"], ("target",))
    if method == OWN:
        rows = [row for row in rows if row["net"] != "displacement"]
    return mean((row for row in rows if row["method"] == method), "r2")


def summary(values: Mapping[str, Any]) -> str:
    """Return the chain beside the baselines, the paper's figures, and what both are."""
    parts = [name for name in TITLES if name in values]
    columns = ("source-only", NEAREST, "displacement", "field", "m2m", OWN)
    lines = [[TITLES[name], *(r2(values[name], method) for method in columns)] for name in parts]
    forces = {
        name: by_held_out(values[name]["forces"], values[name]["held out"], ("target",))[0]
        for name in parts
    }
    head = ["R2, mean of pairs", *columns[:3], "`field`", "paper's chain", "own labels"]
    return f"""\
R2 is the mean of Fx, Fy, Fz on frames of indenters that no network saw, in simulation; labels that
are carried between skins are compensated by force-depth curves. Which way is the best where the
target has no gauge is [another page](gauge.md), with more seeds and other indenters.

{table(head, lines)}

{beside_the_paper(forces)}

Real sensors are in the paper alone. Its networks are wider and start from published weights, and
its losses include LPIPS and an adversary; here the square is the only loss.
[All differences](../reference/fidelity.md)."""


def section(name: str, values: Mapping[str, Any], page: Page) -> str:
    """Return the tables of one part; `patterns` draws the Dice of all pairs of patterns."""
    held_out = values["held out"]
    forces, new = by_held_out(values["forces"], held_out, ("target",))
    texts = [f"## {TITLES[name]}: {_sensors(forces)}", _forces(forces)]
    if new:
        targets = ", ".join(f"`{each}`" for each in dict.fromkeys(row["target"] for row in new))
        texts.append(
            f"On {targets}, which nothing was trained on: R2 {_mean_of(new, 'm2m', 'r2')} by the "
            f"chain, {_mean_of(new, 'field', 'r2')} by `field`, "
            f"{_mean_of(new, 'displacement', 'r2')} by displacement."
        )
    if values.get("patterns"):
        texts.append(_patterns(values["patterns"], held_out, page))
    return "\n\n".join(texts)


def _sensors(rows: Sequence[Row]) -> str:
    names = sorted({row["target"] for row in rows}, key=natural_key)
    return f"{', '.join(f'`{name}`' for name in names)}"


def _mean_of(rows: Sequence[Row], method: str, key: str) -> str:
    return mean((row for row in rows if row["method"] == method), key)


def _forces(rows: Sequence[Row]) -> str:
    lines = []
    for method, words in METHODS.items():
        for net in dict.fromkeys(row["net"] for row in rows if row["method"] == method):
            own = [row for row in rows if (row["method"], row["net"]) == (method, net)]
            interval = f"{mean(own, 'r2_low')} to {mean(own, 'r2_high')}"
            errors = f"{mean(own, 'mae_shear_n')}, {mean(own, 'mae_fz_n')}"
            worst = min(own, key=lambda row: float(row["r2"]))
            ends = worst["target"] if method == OWN else f"{worst['source']} to {worst['target']}"
            named = f"{words}, net `{net}`" if method == OWN else words
            pair = f"{float(worst['r2']):.3f} ({ends})"
            lines.append([named, len(own), mean(own, "r2"), interval, pair, errors])
    head = ["method", "pairs", "R2", "90 % interval", "worst pair", "MAE of shear, Fz [N]"]
    return table(head, lines)


def _patterns(rows: Sequence[Row], held_out: Sequence[str], page: Page) -> str:
    """Return the means of pairs of patterns by what was held out, and draw all pairs."""
    lines = []
    for words, source, target in (
        ("both patterns were trained on", False, False),
        ("the source was held out", True, False),
        ("the target was held out", None, True),
    ):
        own = [
            row
            for row in rows
            if (row["target"] in held_out) == target and source in (None, row["source"] in held_out)
        ]
        dice = f"{mean(own, 'dice_before')}, {mean(own, 'dice_after')}"
        lines.append([words, len(own), dice])
    names = list(dict.fromkeys(row[end] for row in rows for end in ("source", "target")))
    with chart(page.picture("patterns"), 9, 3.6) as figure:
        every = figure.subplots(1, 2)
        for axes, when in zip(every, ("before", "after"), strict=True):
            values = np.full((len(names), len(names)), np.nan)
            for row in rows:
                pair = names.index(row["source"]), names.index(row["target"])
                values[pair] = float(row[f"dice_{when}"])
            image = axes.imshow(values, vmin=0, vmax=1)
            axes.set_xticks(range(len(names)), names, rotation=90, fontsize=6)
            axes.set_yticks(range(len(names)), names, fontsize=6)
            axes.set(title=f"Dice, {when}", xlabel="target", ylabel="source")
        figure.colorbar(image, ax=list(every))
    return f"""All pairs of simulated patterns, M2M after its training on patterns alone:

{table(["pairs", "number", "Dice before, after"], lines)}

{page.link("patterns", "Dice of all pairs of patterns before and after translation")}"""
