"""What the report says of forces: what was gained, beside the paper, pair by pair."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from learning.evaluation import charts
from learning.evaluation.force_table import (
    ALL,
    BEFORE,
    SEEN,
    TARGET,
    UNSEEN,
    ForceRow,
    force_line,
    gain_line,
    of_role,
    variant_name,
    variants,
)
from learning.evaluation.html_page import (
    Cell,
    folded,
    graded,
    heading,
    note,
    number,
    paragraph,
    picture,
    table,
)
from learning.evaluation.paper_figures import Beside
from learning.evaluation.predictions import Predictions
from recorder.strict_yaml import natural_key

ROLES = {
    UNSEEN: "indenters that the models never saw",
    SEEN: "indenters seen, presses never trained on",
    ALL: "all held-out frames",
}
"""What roles are called."""
GAINS = (
    ("r2_mean", "R2, mean of Fx, Fy, Fz"),
    ("mae_fz_n", "MAE Fz [N]"),
    ("mae_shear_n", "MAE shear, mean of Fx and Fy [N]"),
)
"""What the first table shows of each variant."""
SEQUENCES, PRESSES = 3, 10
"""Pairs whose sequences are shown, and presses of each."""

_METHODS = """source-only: trained on the source's images, shown the target's. transferred:
trained on the source's images as translated to the target, with the source's labels.
compensated: the same with labels corrected for the softness of the skins as the paper does most
often (d0 0, lambda 0.75). priors: with the correction that suits their force-depth curves best;
neither needs labels of the target. oracle: with the one that suits the target's labels best.
target: trained on the target's own labels."""
_DEFINITIONS = """MAE: mean over frames of |predicted - true|. Ft: magnitude of the force, as
the paper has it. R2: 1 - sum of squared errors / sum of squared deviations of the labels from
their mean, over all frames of the test. /std: MAE over the standard deviation of all labels of
the target."""


def parts(
    predictions: Sequence[Predictions],
    rows: Sequence[ForceRow],
    beside: Sequence[Beside],
    *,
    seed: int,
) -> list[str]:
    """Return the parts of the page; none without predictions."""
    if not rows:
        return []
    written = [heading("Forces before and after"), note(_METHODS)]
    role = next((role for role in ROLES if of_role(rows, role)), rows[0].role)
    for shown in dict.fromkeys([role, *ROLES]):
        if of_role(rows, shown):
            gains = paragraph(_sentence(rows, shown)) + gains_table(of_role(rows, shown))
            name = ROLES.get(shown, shown)
            written.append(gains if shown == role else folded(f"The same: {name}", gains))
    if beside:
        written += [heading("Beside the paper"), *_beside(beside)]
    written += [heading("Pictures"), *_pictures(predictions, of_role(rows, role), role, seed)]
    written += [
        heading("Every error"),
        note(_DEFINITIONS),
        folded(f"{len(rows)} rows", _every(rows)),
    ]
    return written


def gains_table(rows: Sequence[ForceRow]) -> str:
    """Return the table of pairs by before and after, coloured, its first row the mean of all."""
    ways = variants(rows)
    by_pair: dict[tuple[str, str], dict[tuple[str, str], ForceRow]] = {}
    of_target = {row.target: row for row in rows if row.method == TARGET}
    for row in rows:
        if row.method != TARGET:
            by_pair.setdefault((row.source, row.target), {})[row.variant] = row
    if not by_pair:  # nothing but models trained on the target's own labels
        by_pair = {(name, name): {row.variant: row} for name, row in of_target.items()}
    for (_, target), some in by_pair.items():
        if target in of_target:
            some[of_target[target].variant] = of_target[target]
    lines: list[list[Cell | str]] = []
    for (source, target), some in sorted(by_pair.items(), key=_in_order):
        cells = [_gain(some.get(way), measure) for measure, _ in GAINS for way in ways]
        lines.append([f"{source} to {target}", *cells])
    mean: list[Cell | str] = [f"mean of {len(by_pair)} pairs"]
    mean += [
        _mean_gain(list(by_pair.values()), way, measure) for measure, _ in GAINS for way in ways
    ]
    return table(
        ["pair", *(variant_name(way) for _ in GAINS for way in ways)],
        [mean, *lines],
        groups=[("", 1), *((title, len(ways)) for _, title in GAINS)],
        first_is_mean=True,
    )


def _in_order(pair: tuple[tuple[str, str], Any]) -> tuple[Any, ...]:
    return tuple(map(natural_key, pair[0]))


def beside_line(one: Beside) -> dict[str, Any]:
    """Return a figure of the paper and ours as a line of the CSV."""
    figure = asdict(one.figure)
    figure["pair"] = " to ".join(one.figure.pair) if one.figure.pair else ""
    ours = {key: value for key, value in asdict(one).items() if key != "figure"}
    return {**figure, **ours}


def _goodness(row: ForceRow, measure: str) -> float:
    """Return 0 to 1: R2 itself; of an error, what is missing of half the labels' spread."""
    if measure.startswith("r2"):
        return row.value(measure)
    fx, fy, fz, _ = row.errors.relative
    relative = fz if measure == "mae_fz_n" else 0.5 * (fx + fy)
    return 1 - 2 * relative


def _gain(row: ForceRow | None, measure: str) -> Cell:
    return Cell("") if row is None else graded(row.value(measure), _goodness(row, measure))


def _mean_gain(
    pairs: Sequence[dict[tuple[str, str], ForceRow]], way: tuple[str, str], measure: str
) -> Cell:
    rows = [some[way] for some in pairs if way in some]
    if not rows:
        return Cell("")
    value = float(np.mean([row.value(measure) for row in rows]))
    return graded(value, float(np.mean([_goodness(row, measure) for row in rows])))


def _sentence(rows: Sequence[ForceRow], role: str) -> str:
    frames = max(row.errors.frames for row in of_role(rows, role))
    gained = gain_line(rows, role).replace("  ", "; ")
    return f"On {ROLES.get(role, role)}, up to {frames:,} frames a pair: {gained}."


def _beside(beside: Sequence[Beside]) -> list[str]:
    lines: list[list[Cell | str]] = []
    for one in beside:
        figure = one.figure
        where = (
            " to ".join(figure.pair) if figure.pair else figure.which and f"{figure.which} target"
        )
        if figure.which == "others":
            where = "sources but uskin"
        pairs = f"{one.pairs} of {one.of}"
        ratio = one.our_share / one.paper_share if one.paper_share else float("nan")
        lines.append(
            [
                figure.group,
                variant_name((figure.method, one.translator)),
                f"{figure.measure}, {figure.statistic}",
                where or "",
                Cell(f"{figure.relation}{figure.value:g}"),
                number(one.held_out),
                number(one.unseen),
                number(100 * one.paper_share, 1),
                graded(100 * one.our_share, 1.25 - 0.75 * ratio, 1),
                Cell(pairs),
                figure.cited,
            ]
        )
    columns = ["test", "method", "measure", "pair", "paper", "ours", "ours, unseen"]
    columns += ["paper, % of range", "ours, % of range", "our pairs", "paper, where"]
    return [
        note(
            "fx, fy, fz, shear: MAE [N]; max, min, mean: over pairs, where the paper names the "
            "pair it is its own worst or best. Ours: all held-out frames of the pairs that are "
            "here. Of range: of that of the labels; the paper's are 18 N normal and 8 N shear, "
            "ours those of each target. The paper gives no spread of its labels, and its test has "
            "training indenters in it."
        ),
        table(columns, lines),
    ]


def _pictures(
    predictions: Sequence[Predictions], rows: Sequence[ForceRow], role: str, seed: int
) -> list[str]:
    transfers = [row for row in rows if row.method != TARGET]
    transfers.sort(key=lambda row: (row.source, row.target))  # one order of pairs everywhere
    ways = variants(transfers)
    by_way = {way: [row for row in transfers if row.variant == way] for way in ways}
    written: list[str] = []
    name = ROLES.get(role, role)
    if by_way:
        for measure, title, good in (
            ("r2_mean", f"R2, mean of axes; {name}", "high"),
            ("mae_fz_n", f"MAE Fz [N]; {name}", "low"),
            ("mae_shear_n", f"MAE shear [N]; {name}", "low"),
        ):
            written.append(picture(charts.heatmaps(by_way, measure, title, good), title))
    before = next((by_way[way] for way in ways if way[0] == BEFORE), [])
    for way in ways:
        if way[0] != BEFORE:
            names = BEFORE, variant_name(way)
            drawn = charts.radar(before, by_way[way], names)
            written.append(picture(drawn, f"errors of all pairs, {names[1]}"))
    return written + _sequences(predictions, transfers, role, seed)


def _sequences(
    predictions: Sequence[Predictions], rows: Sequence[ForceRow], role: str, seed: int
) -> list[str]:
    """Return the sequences of the worst, the middle and the best pair, by R2 after."""
    after = [row for row in rows if row.method != BEFORE] or list(rows)
    score: dict[tuple[str, str], float] = {}
    for row in after:
        pair = row.source, row.target
        score[pair] = max(score.get(pair, -np.inf), row.errors.r2_mean)
    pairs = sorted(score, key=lambda pair: score[pair])
    places = np.unique(np.linspace(0, len(pairs) - 1, SEQUENCES).round().astype(int))
    written = []
    for source, target in [pairs[place] for place in places if pairs]:
        shown = [one for one in predictions if (one.source, one.target) == (source, target)]
        shown = [one.only(_held(one, role)) for one in shown]
        shown = sorted((one for one in shown if len(one)), key=lambda one: one.method != BEFORE)
        if shown:
            text = f"{source} to {target}: R2 {score[source, target]:.3f} at best"
            drawn = charts.sequences(shown, PRESSES, seed)
            written += [paragraph(text), picture(drawn, text)]
    return written


def _held(one: Predictions, role: str) -> Any:
    return np.isin(one.role, (UNSEEN, SEEN)) if role == ALL else one.role == role


def _every(rows: Sequence[ForceRow]) -> str:
    lines: list[list[Cell | str]] = []
    for row in rows:
        said = force_line(row)
        texts = [str(said[name]) for name in ("source", "target", "method", "translator", "role")]
        values = list(said.values())[len(texts) + 1 :]
        lines.append([*texts, Cell(f"{said['frames']:,}"), *(number(value, 3) for value in values)])
    names = [_column(name) for name in force_line(rows[0])]
    return table(names, lines)


def _column(name: str) -> str:
    text = name.replace("mae_", "MAE ").replace("r2_", "R2 ").replace("_over_std", " /std")
    return text.replace("_n", " [N]") if name.startswith("mae_") else text
