"""All groups of a page of tables at a glance."""

from __future__ import annotations

import math
from collections.abc import Sequence

from benchmarks.learning.tables.group_results import Group, mean
from benchmarks.learning.tables.markdown import head, line, or_dash
from learning.evaluation.paper_figures import NORMAL, SHEAR, label_share
from learning.evaluation.predictions import BEFORE, TARGET, ForceRow, variant_name

TOLD = """\
Means over pairs, on unseen indenters. `before`: the source's model on the target's own frames;
`after`: the model named, which learned from no label of the target; `but for one`: the same without
the indenter that costs most; `own labels`: the target's model. `labels alone`: R2 of the labels
that the model named learned from, were they predictions of the target's own, on the presses that it
learned from."""


def overview(groups: Sequence[Group]) -> list[str]:
    """Return a line for each group; nothing of one group, which says it all itself."""
    if len(groups) < 2:
        return []
    lines = ["", "## At a glance", "", *TOLD.splitlines(), ""]
    lines += head(
        "",
        "pairs",
        "model",
        "R2 before",
        "after",
        "worst pair",
        "but for one",
        "own labels",
        "labels alone",
        "MAE of shear, Fz [N]",
        "over the labels' range [%]",
        "Dice",
    )
    for group in groups:
        best = group.best
        rows = group.rows(group.after, best)
        fits = _fits(rows)
        newtons = mean(row.errors.shear for row in rows), mean(row.errors.mae[2] for row in rows)
        shares = (100 * mean(label_share(row, axes) for row in rows) for axes in (SHEAR, NORMAL))
        lines.append(
            line(
                group.name,
                str(group.pairs),
                variant_name((group.after, best)),
                or_dash(mean(_fits(group.rows(BEFORE))), ".3f"),
                or_dash(mean(fits), ".3f"),
                f"{min(fits):.3f}",
                _but_for_one(group, best),
                or_dash(mean(_fits(group.rows(TARGET))), ".3f"),
                or_dash(mean(group.label_fits()), ".3f"),
                ", ".join(f"{value:.3f}" for value in newtons),
                ", ".join(f"{value:.1f}" for value in shares),
                or_dash(mean(group.dice(best).values()), ".3f"),
            )
        )
    return lines


def _but_for_one(group: Group, best: str) -> str:
    found = group.indenters[group.after, best]
    known = [one for one in found if math.isfinite(one.r2_of_others)]
    if not known:
        return "-"
    most = max(known, key=lambda one: one.r2_of_others)
    return f"{most.r2_of_others:.3f} ({most.indenter})"


def _fits(rows: Sequence[ForceRow]) -> list[float]:
    return [row.errors.r2_mean for row in rows]
