"""docs/results/cost-table.md: what the table says, and whether its promises hold."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.sim.cost_table.validation import (
    TOLERANCES,
    Validation,
    Verdict,
    by_group,
    each_bar,
    share_covered,
    share_kept,
)
from sim.planner.error_model import BAR_FLOOR, FEW, PROMISED, CostRow, Model, Table
from sim.planner.features import GROUPS, KINDS, NAMES, WHAT, Choice, Kind
from sim.planner.seconds import SecondsModel, Timed

LINE = 99
"""Longest line of a paragraph."""

_INTRO = """# What an error costs, and which choice is made

`simulate(scene, tolerance="2 %")` looks at the scene through one run of `layer` (milliseconds),
predicts the error and the time of every tier, mesh and precision from a stored table, and takes
the cheapest within the tolerance; `plan(scene, "2 %")` tells without solving.
`result.record["plan"]` says what was taken, why, and what the next cheaper and dearer would give.
Made by `make cost-table`; the table is `sim/planner/cost_table.csv`, a row a scene and choice, and
goes with the package.

{conditions}

## The model

A tolerance is the largest error at any frame: of the force along x, y or z, in per cent of the
frame's force (or of a tenth of the largest) or in N; or the root mean square of 14 x 14 markers'
distances in the paper's camera, in px.

What decides an error has no units: the size of an element over the width of the contact (2 area /
outline, as `layer` finds it), over the sharpest radius and over the thickness; depth over
thickness and over width of the contact; nu; friction; way aside; nearness of a side; viscosity.
log(error) is a ridge regression on these, one for `layer` and one for all meshes of `fem`. To it
is added what it misses: each scene is predicted from a fit without it, and the {promised:g} %
conformal quantile of the misses, of scenes of the same mesh and group, is the margin. A choice
that found no solution misses by any margin. A group with fewer than 19 scenes has its largest miss
and a factor of {few:g}. Errors in N and px are predicted over the force and the motion of the
markers in `layer`.

Groups: an indenter is smooth where its sharpest radius is above 0.6 of the width of the contact,
else edged; it presses or shears; viscous scenes are one group. Scenes whose features lie beyond
the table's (and a twentieth of their range) are refused by name, as are domes, inertia and
gravity; a body narrower or wider than the table's only rules out `layer`, which has no sides.
`mpm` is never chosen: at every error `fem` takes less time ([accuracy.md](accuracy.md)).
"""

_BARS = """
## Error bars

`simulate(scene, error_bar=True)` solves a mesh at least 1.3 times as coarse as well (`layer` is
held against a coarse `fem`) and multiplies the difference by a factor that covered the error of
{promised:g} % of the table's scenes of that group; differences below {floors} count as that.
"""


def write_page(
    path: Path,
    table: Table,
    model: Model,
    seconds: SecondsModel,
    timed: Sequence[Timed],
    held_out: Table | None,
    validation: Validation | None,
) -> None:
    """Write the page; without held-out scenes it says that nothing was checked yet."""
    conditions = "\n".join(
        f"- {name}: {value}" for name, value in table.conditions.items() if name != "numerics"
    )
    scenes = {row.scene: row for row in table.rows}
    counts = ", ".join(f"{count} {group}" for group, count in model.counts.items())
    lines = [
        _INTRO.format(
            conditions=f"{conditions}\n- fem with its default settings but for the mesh\n"
            f"- {len(scenes)} scenes: {counts}",
            promised=100 * PROMISED,
            few=FEW,
        )
    ]
    lines += _coverage_lines(model)
    lines += _error_lines(table)
    lines += _precision_lines(table)
    lines += _seconds_lines(table, seconds, timed)
    floors = f"{100 * BAR_FLOOR['share']:g} % ({100 * BAR_FLOOR['marker']:g} % of the markers)"
    lines.append(_BARS.format(promised=100 * PROMISED, floors=floors))
    lines += _bar_lines(model)
    lines += ["", "## Checked on scenes that the table was not made from", ""]
    if held_out is None or validation is None:
        lines.append("Not yet: `python -m benchmarks cost-table --validate`.")
    else:
        lines += _validation_lines(model, held_out, validation)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _coverage_lines(model: Model) -> list[str]:
    rows = [
        (WHAT[name], f"{low:.3g} to {high:.3g}")
        for name, low, high in zip(NAMES, model.low, model.high, strict=True)
    ]
    return ["", "## What the table covers", "", *_table(("feature", "from, to"), rows)]


def _choices(table: Table) -> list[Choice]:
    """Those in float32, `layer` first."""
    known = {row.choice for row in table.rows if row.choice.precision == "float32"}
    return sorted(known, key=lambda choice: choice.cells)


def _error_lines(table: Table) -> list[str]:
    head = ("", *GROUPS, "unsolved")
    lines = ["", "## Errors of the force [%]: median, and 95th percentile", ""]
    rows = []
    for choice in _choices(table):
        mine = [row for row in table.rows if row.choice == choice]
        unsolved = sum(math.isinf(row.error["share"]) for row in mine)
        cells = [_spread(_of(mine, group, "share"), 100) for group in GROUPS]
        rows.append((str(choice), *cells, str(unsolved)))
    lines += _table(head, rows)
    lines += ["", "Of the markers, in per cent of their motion:", ""]
    rows = []
    for choice in _choices(table):
        mine = [row for row in table.rows if row.choice == choice]
        rows.append((str(choice), *(_spread(_of(mine, group, "marker"), 100) for group in GROUPS)))
    return lines + _table(head[:-1], rows)


def _of(rows: Iterable[CostRow], group: str, kind: Kind) -> list[float]:
    return [row.error[kind] for row in rows if row.features.group == group]


def _spread(values: Sequence[float], unit: float) -> str:
    known = [value for value in values if math.isfinite(value)]
    if not known:
        return "-"
    middle, high = np.percentile(known, [50, 95]) * unit
    return f"{middle:.2g}, {high:.2g}"


def _precision_lines(table: Table) -> list[str]:
    double = [row for row in table.rows if row.choice.precision == "float64"]
    values = [row.bar["share"] for row in double if math.isfinite(row.bar["share"])]
    if not values:
        return []
    middle, high = 100 * np.percentile(values, [50, 95])
    return [
        "",
        *_wrapped(
            f"float32 against float64 on one mesh moves the force by {middle:.1g} % (median), "
            f"{high:.1g} % (95th percentile of {len(values)} scenes): both are given "
            "the same error, and float64, which takes longer, is taken by itself where float32 "
            "does not converge."
        ),
    ]


def _seconds_lines(table: Table, seconds: SecondsModel, timed: Sequence[Timed]) -> list[str]:
    lines = [
        "",
        "## Seconds",
        "",
        *_wrapped(
            "Elements, Newton and conjugate-gradient iterations are predicted from the table; "
            "seconds are a + b newton + c cg + elements (d newton + e cg), no share below 0, "
            "fitted to presses timed one by one, kernels compiled. `python -m benchmarks "
            "cost-table --seconds --device ...` fits them anew."
        ),
        "",
    ]
    rows = []
    for (device, tier, precision), shares in sorted(seconds.shares.items()):
        mine = [
            one
            for one in timed
            if (one.device, one.choice.tier, one.choice.precision) == (device, tier, precision)
        ]
        machine = ", ".join(sorted({one.machine for one in mine}))
        rows.append(
            (device, machine, f"{tier} {precision}", str(len(mine)),
             ", ".join(f"{share:.2g}" for share in shares))
        )  # fmt: skip
    lines += _table(("device", "machine", "solver", "presses", "a, b, c, d, e [s]"), rows)
    ratios = []
    first: dict[tuple[str, Choice], CostRow] = {
        (row.scene, row.choice): row for row in table.rows if row.work["newton"]
    }
    for row in first.values():
        if row.choice.tier == "fem" and row.choice.precision == "float32":
            ratios.append(_work_ratio(seconds, row))
    if ratios:
        low, middle, high = np.percentile(ratios, [5, 50, 95])
        lines += [
            "",
            *_wrapped(
                f"Predicted over true work (elements times cg) of the table's own scenes: "
                f"{low:.2g}, {middle:.2g}, {high:.2g} (5th, 50th, 95th percentile)."
            ),
        ]
    return lines


def _work_ratio(seconds: SecondsModel, row: CostRow) -> float:
    work = seconds.predicted_work(row.features, row.choice)
    return work["elements"] * work["cg"] / (row.work["elements"] * max(row.work["cg"], 1.0))


def _bar_lines(model: Model) -> list[str]:
    rows = [
        (tier, group, *(f"{model.bars[tier, group, kind]:.3g}" for kind in KINDS))
        for tier in ("layer", "fem")
        for group in GROUPS
        if math.isfinite(model.bars[tier, group, "share"])
    ]
    return _table(("tier", "group", "factor: force, %", "force, N", "markers, px"), rows)


def _validation_lines(model: Model, held_out: Table, validation: Validation) -> list[str]:
    promises = validation.chosen()
    bars = each_bar(model, held_out)
    beyond: dict[str, int] = {}
    for names in validation.outside.values():
        for name in names:
            beyond[name] = beyond.get(name, 0) + 1
    refused = ", ".join(f"{WHAT[name]} {count}" for name, count in sorted(beyond.items()))
    scenes = f"{held_out.conditions['scenes']}; ranges wider in everything, with boxes and bars"
    lines = [
        *_wrapped(
            f"{validation.scenes} scenes ({scenes}). {len(validation.outside)} lie outside of the "
            f"table and are refused ({refused or 'none'}); promises were made for "
            f"{validation.planned}."
        ),
        "",
        f"**{100 * share_kept(promises):.1f} % of {len(promises)} promised tolerances hold; "
        f"{100 * share_covered(bars):.1f} % of {len(bars)} error bars cover the true error.**",
        "",
    ]
    groups, bar_groups = by_group(promises), by_group(bars)
    rows = []
    for group in GROUPS:
        mine = groups[group]
        count = len({one.scene for one in mine})
        cells = [_held(one for one in mine if one.kind == kind) for kind in KINDS]
        rows.append((group, str(count), *cells, _covered(bar_groups[group])))
    lines += _table(
        ("group", "scenes", "%: kept", "N: kept", "px: kept", "error bars that cover"), rows
    )
    lines += ["", "By tolerance (force and markers over their largest), and what was taken:", ""]
    rows = []
    for kind in KINDS:
        for tolerance in TOLERANCES[kind]:
            asked = [
                one
                for one in validation.verdicts
                if one.kind == kind and one.tolerance == tolerance
            ]
            mine = [one for one in asked if one.choice is not None]
            taken: dict[str, int] = {}
            for one in mine:
                name = "layer" if one.choice and one.choice.tier == "layer" else (
                    f"1/{one.choice.cells}" if one.choice else ""
                )  # fmt: skip
                taken[name] = taken.get(name, 0) + 1
            words = ", ".join(f"{name}: {count}" for name, count in taken.items())
            rows.append(
                (_UNIT[kind], f"{100 * tolerance:g} %", _held(mine), str(len(asked) - len(mine)),
                 words)
            )  # fmt: skip
    return lines + _table(("of", "tolerance", "kept", "refused", "taken"), rows)


_UNIT: dict[Kind, str] = {
    "share": "force of the frame",
    "force": "largest force",
    "marker": "motion of the markers",
}


def _held(verdicts: Iterable[Verdict]) -> str:
    known = list(verdicts)
    return f"{100 * share_kept(known):.0f} % of {len(known)}" if known else "-"


def _covered(verdicts: Iterable[Verdict]) -> str:
    known = list(verdicts)
    return f"{100 * share_covered(known):.0f} % of {len(known)}" if known else "-"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    return [*lines, *(f"| {' | '.join(row)} |" for row in rows)]


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, LINE, break_long_words=False, break_on_hyphens=False)
