"""Sections of the page: forces of each part, patterns, and the paper's figures."""

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


def trained(values: Mapping[str, Any]) -> list[Row]:
    """Return the rows of forces whose target was trained on."""
    return [row for row in values["forces"] if row["target"] not in values["held out"]]


def mean(rows: Iterable[Row], key: str, method: str | None = None) -> str:
    """Return the mean of a column, of one method if it is named; `-` without a number."""
    some = [float(row[key]) for row in rows if method in (None, row.get("method"))]
    return f"{np.mean(some):.3f}" if np.isfinite(some).any() else "-"


def summary(values: Mapping[str, Any]) -> str:
    """Return the chain beside the baselines, the paper's figures, and what both are."""
    parts = [name for name in TITLES if name in values]
    columns = ("source-only", NEAREST, "displacement", "field", "m2m", OWN)
    forces = {name: trained(values[name]) for name in parts}
    lines = []
    for name, rows in forces.items():
        # Own labels are learned by the net of the chain, and by that of displacement.
        some = [row for row in rows if (row["method"], row["net"]) != (OWN, "displacement")]
        lines.append([TITLES[name], *(mean(some, "r2", method) for method in columns)])
    head = ["R2, mean of pairs", "source only", *columns[1:3], "`field`", "the chain", OWN]
    return f"""\
R2 is the mean of Fx, Fy, Fz on frames of indenters that no network saw, in simulation; labels that
are carried between skins are compensated by force-depth curves. Which way is the best where the
target has no gauge is [another page](gauge.md), with more seeds and other indenters. *Source only*
is the source's net on the target's frames as they are. The chain is the paper's: M2M, marker to
marker, translates frames by diffusion, then a net is trained; `field` is our translator, which
moves the target's own markers. Dice is the overlap of two marker images: 1 if equal, 0 if none.

{table(head, lines)}

{beside_the_paper(forces)}

The paper's (Fig. 5 to 7) are of real sensors, up to 18 N, 4 N of shear, and of all indenters; its
networks are larger, trained from published weights with LPIPS and an adversary, here with the
square alone. Patterns: why no pair is as good by the source alone as the paper's best is not known.
Skins: from hard to soft its R2 falls from 0.8 to 0.4, as labels are not compensated; ours are, by
exact curves, as skins differ by modulus alone (2.5 : 1). Kinds: the moduli of pads are assumed.
FID and KID (Fig. 3, 5a, 5b) are not measured: they need Inception's weights from the user.
[All differences](../reference/fidelity.md)."""


def section(name: str, values: Mapping[str, Any], page: Page) -> str:
    """Return the tables of one part; `patterns` draws the Dice of all pairs of patterns."""
    held_out, forces = values["held out"], trained(values)
    sensors = sorted({row["target"] for row in forces}, key=natural_key)
    words = ", ".join(f"`{each}`" for each in sensors)
    texts = [f"## {TITLES[name]}: {words}", _forces(forces)]
    if new := [row for row in values["forces"] if row["target"] in held_out]:
        targets = ", ".join(f"`{each}`" for each in dict.fromkeys(row["target"] for row in new))
        texts.append(
            f"On {targets}, which nothing was trained on: R2 {mean(new, 'r2', 'm2m')} by the "
            f"chain, {mean(new, 'r2', 'field')} by `field`, {mean(new, 'r2', 'displacement')} by "
            "displacement."
        )
    if values.get("patterns"):
        texts.append(_patterns(values["patterns"], held_out, page))
    return "\n\n".join(texts)


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
    for words, sources, target in (
        ("both patterns were trained on", (False,), False),
        ("the source was held out", (True,), False),
        ("the target was held out", (False, True), True),
    ):
        alike = [row for row in rows if (row["target"] in held_out) == target]
        own = [row for row in alike if (row["source"] in held_out) in sources]
        dice = f"{mean(own, 'dice_before')}, {mean(own, 'dice_after')}"
        lines.append([words, len(own), dice])
    names = list(dict.fromkeys(row[end] for row in rows for end in ("source", "target")))
    labels = [f"{name} (held out)" if name in held_out else name for name in names]
    with chart(page.picture("patterns"), 9, 3.6) as figure:
        every = figure.subplots(1, 2)
        for axes, when in zip(every, ("before", "after"), strict=True):
            values = np.full((len(names), len(names)), np.nan)
            for row in rows:
                pair = names.index(row["source"]), names.index(row["target"])
                values[pair] = float(row[f"dice_{when}"])
            image = axes.imshow(values, vmin=0, vmax=1)
            axes.set_xticks(range(len(names)), labels, rotation=90, fontsize=6)
            axes.set_yticks(range(len(names)), labels, fontsize=6)
            axes.set(title=f"Dice, {when}", xlabel="target", ylabel="source")
        figure.colorbar(image, ax=list(every))
    return f"""All pairs of simulated patterns, M2M after its training on patterns alone:

{table(["pairs", "number", "Dice before, after"], lines)}

{page.link("patterns", "Dice of all pairs of patterns before and after translation")}"""
