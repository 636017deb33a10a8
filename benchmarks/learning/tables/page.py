"""The paper's tables for groups of sensors: a page, its CSV files and plots."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.learning.tables.group_results import NO_TRANSLATOR, Group, mean
from learning.compensation import Choice
from learning.evaluation.charts import heatmaps
from learning.evaluation.paper_figures import NORMAL, PAPER, SHEAR, label_share, paper_share
from learning.evaluation.predictions import (
    BEFORE,
    CHOICES,
    TARGET,
    ForceRow,
    csv_text,
    force_line,
    variant_name,
    variants,
)
from learning.evaluation.report import beside_line
from learning.evaluation.translation import TRANSLATED, score_line
from recorder.store.durable import replace_file
from recorder.strict_yaml import natural_key

# Goal for R2 on unseen indenters, mean over axes and pairs.
GOAL_R2 = {"homogeneous": 0.95, "heterogeneous": 0.9}
# Goal for the Dice score, and for translation from the taxels of a uSkin.
GOAL_DICE, GOAL_DICE_TAXELS = 0.97, 0.93
# Goal for the errors relative to the paper's: both as shares of the range of the labels.
GOAL_SHARE = 0.5
# Text above the table of all groups.
TOLD = """\
Means over pairs, on unseen indenters. `before`: the source's model on the target's own frames;
`after`: the model named, trained without any label of the target; `without one`: the same without
the indenter that costs most; `own labels`: the target's model. `labels alone`: R2 of the training
labels of the model named, compared with the target's own labels, on the presses that it was
trained on."""
TITLE = "# Forces on sensors that never saw a force gauge"


def write_tables(groups: Sequence[Group], out: Path, intro: str = "") -> list[Path]:
    """Write the page `out`, and its CSV files and plots in a folder of the same name.

    Args:
        groups: Groups in the order of the page.
        out: Path of the page, which must end in .md.
        intro: Text above the tables; its first line is the page's title if it begins with #.

    Raises:
        LearningError: A group without forces.
        OSError: The folder is not writable.
    """
    folder = out.with_suffix("")
    folder.mkdir(parents=True, exist_ok=True)
    titled = [] if intro.startswith("# ") else [TITLE, ""]
    lines = [*titled, *intro.splitlines(), *_overview(groups)]
    written = [out]
    tables: dict[str, list[dict[str, Any]]] = {"force": [], "translation": [], "paper": []}
    for group in groups:
        picture = folder / f"{group.name}.png"
        replace_file(picture, _picture(group))
        written.append(picture)
        lines += _section(group, f"{folder.name}/{picture.name}")
        named = {"group": group.name}
        tables["force"] += [named | force_line(row) for row in group.force]
        tables["translation"] += [named | score_line(one, row) for one, row in group.scores]
        tables["paper"] += [{"experiment": group.name} | beside_line(one) for one in group.beside]
    for name, rows in tables.items():
        if rows:
            path = folder / f"{name}.csv"
            replace_file(path, csv_text(rows).encode())
            written.append(path)
    replace_file(out, ("\n".join(lines) + "\n").encode())
    return written


def _picture(group: Group) -> bytes:
    shown = [(BEFORE, NO_TRANSLATOR), (group.after, group.best), (TARGET, NO_TRANSLATOR)]
    by_variant = {variant: rows for variant in shown if (rows := group.rows(*variant))}
    return heatmaps(by_variant, "r2_mean", f"{group.name}: R2 on unseen indenters", "high")


def _overview(groups: Sequence[Group]) -> list[str]:
    """Return a row for each group, or nothing for a single group."""
    if len(groups) < 2:
        return []
    lines = ["", "## At a glance", "", *TOLD.splitlines(), ""]
    lines += _head(
        "",
        "pairs",
        "model",
        "R2 before",
        "after",
        "worst pair",
        "without one",
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
        denormalise = (
            mean(row.errors.shear for row in rows),
            mean(row.errors.mae[2] for row in rows),
        )
        shares = (100 * mean(label_share(row, axes) for row in rows) for axes in (SHEAR, NORMAL))
        lines.append(
            _line(
                group.name,
                str(group.pairs),
                variant_name((group.after, best)),
                _or_dash(mean(_fits(group.rows(BEFORE))), ".3f"),
                _or_dash(mean(fits), ".3f"),
                f"{min(fits):.3f}",
                _but_for_one(group, best),
                _or_dash(mean(_fits(group.rows(TARGET))), ".3f"),
                _or_dash(mean(group.label_fits()), ".3f"),
                ", ".join(f"{value:.3f}" for value in denormalise),
                ", ".join(f"{value:.1f}" for value in shares),
                _or_dash(mean(group.dice(best).values()), ".3f"),
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
    return [_r2(row) for row in rows]


def _section(group: Group, picture: str) -> list[str]:
    best = group.best
    return [
        "",
        f"## {group.name[:1].upper()}{group.name[1:]}",
        "",
        f"{group.pairs} pair{'s' * (group.pairs != 1)}; on the diagonal a sensor's model from its "
        "own labels.",
        "",
        f"![R2 of all pairs before and after]({picture})",
        "",
        *_goals(group, best),
        *_models(group),
        *_indenters(group, best),
        *_labels(group),
        *_translations(group),
        *_pairs(group, best),
        *_paper(group),
    ]


def _goals(group: Group, best: str) -> list[str]:
    rows = group.rows(group.after, best)
    lines = _head(f"goal ({variant_name((group.after, best))})", "required", "mean", "worst pair")
    kind = group.name.removesuffix("-full")
    if kind in GOAL_R2:
        values = {_pair(row): _r2(row) for row in rows}
        lines.append(_line("R2", f"above {GOAL_R2[kind]:g}", *_mean_and_worst(values, min, ".3f")))
    for axes, name in ((NORMAL, "Fz"), (SHEAR, "shear")):
        paper = _paper_worst(kind, axes)
        if math.isfinite(paper):
            values = {_pair(row): 100 * label_share(row, axes) for row in rows}
            asked = f"below {100 * GOAL_SHARE * paper:.1f} % (the paper's worst: {100 * paper:.1f})"
            found = _mean_and_worst(values, max, ".1f")
            lines.append(_line(f"MAE of {name} over the labels' range [%]", asked, *found))
    dice = group.dice(best)
    for taxels, asked_dice in ((False, GOAL_DICE), (True, GOAL_DICE_TAXELS)):
        values = {
            f"{source} to {target}": value
            for (source, target), value in dice.items()
            if (source == "uskin") == taxels
        }
        if values:
            name = "Dice from a uSkin" if taxels else "Dice"
            found = _mean_and_worst(values, min, ".3f")
            lines.append(_line(name, f"above {asked_dice:g}", *found))
    return lines


def _models(group: Group) -> list[str]:
    lines = ["", "Means over pairs:", ""]
    lines += _head(
        "model", "pairs", "Fx, Fy, Fz [N]", "over the labels' std", "R2 of Fx, Fy, Fz", "R2"
    )
    for variant in variants(group.force):
        rows = group.rows(*variant)
        errors = [row.errors for row in rows]
        denormalise = (f"{mean(each.mae[axis] for each in errors):.3f}" for axis in range(3))
        relative = (f"{mean(each.relative[axis] for each in errors):.2f}" for axis in range(3))
        fit = (f"{mean(each.r2[axis] for each in errors):.2f}" for axis in range(3))
        cells = (", ".join(denormalise), ", ".join(relative), ", ".join(fit))
        whole = f"{mean(each.r2_mean for each in errors):.3f}"
        lines.append(_line(variant_name(variant), str(len(rows)), *cells, whole))
    return lines


def _indenters(group: Group, best: str) -> list[str]:
    found = group.indenters[group.after, best]
    lines = ["", f"By indenter, {variant_name((group.after, best))}:", ""]
    lines += _head("indenter", "largest force [N]", "MAE of shear, Fz [N]", "R2 of all others")
    for one in found:
        errors = f"{one.shear:.3f}, {one.normal:.3f}"
        others = _or_dash(one.r2_of_others, ".3f")
        lines.append(_line(one.indenter, f"{one.reach:.1f}", errors, others))
    return lines


def _labels(group: Group) -> list[str]:
    """Return the table that compares transferred labels with the target's own."""
    if group.labels is None:
        return []
    found: dict[str, dict[str, Choice]] = {}
    for pair in group.labels.pairs:
        for name, choice in {"as they are": pair.before, **pair.choices}.items():
            found.setdefault(name, {})[f"{pair.source} to {pair.target}"] = choice
    lines = [
        "",
        "The source's labels compared with the target's own (training presses, paired locations):",
    ]
    lines += ["", *_head("labels", "R2", "worst pair", "distance [N]", "worst pair")]
    methods = {choice: method for method, choice in CHOICES.items()}
    for name, choices in found.items():
        fits = {pair: one.r2 for pair, one in choices.items() if one.r2 is not None}
        apart = {pair: one.error for pair, one in choices.items() if one.error is not None}
        if apart:
            fit = _mean_and_worst(fits, min, ".3f") if fits else ("-", "-")
            cells = (*fit, *_mean_and_worst(apart, max, ".3f"))
            lines.append(_line(methods.get(name, name), *cells))
    return lines


def _translations(group: Group) -> list[str]:
    if not group.scores:
        return []
    lines = ["", "Translated images compared with the true ones, means over pairs:", ""]
    lines += _head("images", "Dice", "centroids [px]", "[mm]", "field error [px]", "count off [%]")
    kinds = sorted({(row.method != TRANSLATED, row.method) for _one, row in group.scores})
    for other, method in kinds:
        of_method = [(one.translator, row) for one, row in group.scores if row.method == method]
        # The baselines are the same for all translators.
        for translator in sorted({name for name, _row in of_method}):
            rows = [row for name, row in of_method if name == translator]
            cells = [f"{mean(row.dice for row in rows):.3f}"]
            cells += [f"{mean(row.centroid_px for row in rows):.2f}"]
            cells += [f"{mean(row.centroid_mm for row in rows):.3f}"]
            known = (row.epe_px for row in rows if math.isfinite(row.epe_px))
            cells += [_or_dash(mean(known), ".2f")]
            cells += [f"{100 * mean(row.count_mismatch for row in rows):.0f}"]
            lines.append(_line(method if other else f"by {translator}", *cells))
            if other:
                break
    return lines


def _pairs(group: Group, best: str) -> list[str]:
    own = {row.target: row for row in group.rows(TARGET)}
    before = {_pair(row): row for row in group.rows(BEFORE)}
    dice = group.dice(best)
    lines = ["", f"All pairs, {variant_name((group.after, best))}:", ""]
    lines += _head(
        "pair",
        "R2 before",
        "after",
        "own labels",
        "MAE of shear, Fz [N]",
        "over the labels' std",
        "Dice",
    )
    for row in sorted(group.rows(group.after, best), key=_in_order):
        first, target = before.get(_pair(row)), own.get(row.target)
        relative = row.errors.relative
        lines.append(
            _line(
                _pair(row),
                f"{_r2(first):.2f}" if first else "-",
                f"{_r2(row):.2f}",
                f"{_r2(target):.2f}" if target else "-",
                f"{row.errors.shear:.3f}, {row.errors.mae[2]:.3f}",
                f"{(relative[0] + relative[1]) / 2:.2f}, {relative[2]:.2f}",
                f"{dice[row.source, row.target]:.3f}" if (row.source, row.target) in dice else "-",
            )
        )
    return lines


def _paper(group: Group) -> list[str]:
    shown = [one for one in group.beside if math.isfinite(one.unseen)]
    if not shown:
        return []
    lines = ["", "The paper's numbers next to ours (unseen indenters; shares of held-out frames):"]
    lines += ["", *_head("figure", "the paper", "ours", "paper / range", "ours / range")]
    for one in shown:
        figure = one.figure
        what = f"{variant_name((figure.method, one.translator))}: {figure.measure}"
        which = " to ".join(figure.pair) if figure.pair and figure.statistic == "pair" else ""
        what += f", {which or ' '.join(filter(None, (figure.statistic, figure.which)))}"
        if one.pairs != one.of:
            what += f" (ours of {one.pairs} pairs, not {one.of})"
        unit = "" if figure.measure.startswith("r2") else " N"
        shares = (
            f"{100 * value:.1f} %" if math.isfinite(value) else "-"
            for value in (one.paper_share, one.our_share)
        )
        paper = f"{figure.relation} {figure.value:g}{unit}".strip()
        lines.append(_line(what, paper, f"{one.unseen:.2f}{unit}", *shares))
    return lines


def _paper_worst(group: str, axes: Sequence[str]) -> float:
    """Return the paper's largest error after translation, over the range of its labels."""
    measures = {*axes} | ({"shear"} if len(axes) > 1 else set())
    found = [
        paper_share(figure)
        for figure in PAPER
        if figure.group == group and figure.method != BEFORE and figure.measure in measures
    ]
    return max(found, default=math.nan)


def _mean_and_worst(
    values: dict[str, float], worst: Callable[..., str], form: str
) -> tuple[str, str]:
    name = worst(values, key=values.__getitem__)
    return f"{mean(values.values()):{form}}", f"{values[name]:{form}} ({name})"


def _r2(row: ForceRow) -> float:
    return row.errors.r2_mean


def _in_order(row: ForceRow) -> tuple[object, ...]:
    return natural_key(row.source), natural_key(row.target)


def _pair(row: ForceRow) -> str:
    return f"{row.source} to {row.target}"


def _head(*cells: str) -> list[str]:
    """Return the two header lines of a table."""
    return [_line(*cells), "|" + "---|" * len(cells)]


def _or_dash(value: float, form: str) -> str:
    """Return a number in a format, or a dash if it is not finite."""
    return f"{value:{form}}" if math.isfinite(value) else "-"


def _line(*cells: str) -> str:
    """Return a line of a table."""
    return f"| {' | '.join(cells)} |"
