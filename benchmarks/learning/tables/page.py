"""The paper's tables for groups of sensors: a page, its CSV files and plots."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks.learning.tables.group_results import NO_TRANSLATOR, Group, mean
from benchmarks.learning.tables.paper_figures import (
    NORMAL,
    PAPER,
    SHEAR,
    beside_line,
    label_share,
    paper_share,
)
from learning.compensation.fit import CHOICE_OF_METHOD, StoredCompensation
from learning.compensation.search import Choice
from learning.evaluation.charts import heatmaps
from learning.evaluation.predictions import (
    BEFORE,
    TARGET,
    ForceRow,
    csv_text,
    force_line,
    variant_name,
    variants,
)
from learning.evaluation.translation import TRANSLATED, PairedScore, score_line
from recorder.natural_order import natural_key
from recorder.pages import render
from recorder.store.files import replace_file

# Goal for R2 on unseen indenters, mean over axes and pairs.
GOAL_R2 = {"homogeneous": 0.95, "heterogeneous": 0.9}
# Goal for the Dice score, and for translation from the taxels of a uSkin.
GOAL_DICE, GOAL_DICE_TAXELS = 0.97, 0.93
# Goal for the errors relative to the paper's: both as fractions of the range of the labels.
GOAL_SHARE = 0.5
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
    written = [out]
    tables: dict[str, list[dict[str, Any]]] = {"force": [], "translation": [], "paper": []}
    for group in groups:
        picture = folder / f"{group.name}.png"
        replace_file(picture, _picture(group))
        written.append(picture)
        named = {"group": group.name}
        tables["force"] += [named | force_line(row) for row in group.force]
        tables["translation"] += [named | score_line(one, row) for one, row in group.scores]
        tables["paper"] += [{"experiment": group.name} | beside_line(one) for one in group.beside]
    for name, rows in tables.items():
        if rows:
            path = folder / f"{name}.csv"
            replace_file(path, csv_text(rows).encode())
            written.append(path)
    text = render(
        Path(__file__).with_suffix(".md"),
        intro="\n".join([*titled, *intro.splitlines()]),
        groups=groups,
        folder=folder.name,
        mean=mean,
        isfinite=math.isfinite,
        variant_name=variant_name,
        variants=variants,
        but_for_one=_but_for_one,
        label_percent=_label_percent,
        shear=SHEAR,
        normal=NORMAL,
        goals=_goals,
        labels=_labels,
        translations=_translations,
        field_error=_field_error,
        pairs=_pairs,
    )
    replace_file(out, text.encode())
    return written


def _picture(group: Group) -> bytes:
    shown = [(BEFORE, NO_TRANSLATOR), (group.after, group.best)]
    by_variant = {variant: rows for variant in shown if (rows := group.rows(*variant))}
    title = f"{group.name}: R2 on unseen indenters"
    return heatmaps(by_variant, "r2_mean", title, "high", own=group.rows(TARGET))


def _but_for_one(group: Group) -> str:
    found = group.indenters[group.after, group.best]
    known = [one for one in found if math.isfinite(one.r2_of_others)]
    if not known:
        return "-"
    most = max(known, key=lambda one: one.r2_of_others)
    return f"{most.r2_of_others:.3f} ({most.indenter})"


def _label_percent(rows: Sequence[ForceRow], axes: Sequence[str]) -> float:
    return 100 * mean(label_share(row, axes) for row in rows)


def _goals(group: Group) -> list[tuple[str, ...]]:
    """Return the goals: name, required value, mean, and worst pair."""
    rows = group.rows(group.after, group.best)
    found: list[tuple[str, ...]] = []
    kind = group.name.removesuffix("-full")
    if kind in GOAL_R2:
        values = {_pair(row): row.errors.r2_mean for row in rows}
        found.append(("R2", f"above {GOAL_R2[kind]:g}", *_mean_and_worst(values, min, ".3f")))
    for axes, name in ((NORMAL, "Fz"), (SHEAR, "shear")):
        paper = _paper_worst(kind, axes)
        if math.isfinite(paper):
            values = {_pair(row): 100 * label_share(row, axes) for row in rows}
            asked = f"below {100 * GOAL_SHARE * paper:.1f} % (the paper's worst: {100 * paper:.1f})"
            name = f"MAE of {name} over the labels' range [%]"
            found.append((name, asked, *_mean_and_worst(values, max, ".1f")))
    dice = group.dice(group.best)
    for taxels, asked_dice in ((False, GOAL_DICE), (True, GOAL_DICE_TAXELS)):
        values = {
            f"{source} to {target}": value
            for (source, target), value in dice.items()
            if (source == "uskin") == taxels
        }
        if values:
            name = "Dice from a uSkin" if taxels else "Dice"
            found.append((name, f"above {asked_dice:g}", *_mean_and_worst(values, min, ".3f")))
    return found


def _labels(labels: StoredCompensation) -> list[tuple[str, ...]]:
    """Return R2 and distance of transferred labels from the target's own: mean, and worst pair."""
    found: dict[str, dict[str, Choice]] = {}
    for pair in labels.pairs:
        for name, choice in {"as they are": pair.before, **pair.choices}.items():
            found.setdefault(name, {})[f"{pair.source} to {pair.target}"] = choice
    methods = {choice: method for method, choice in CHOICE_OF_METHOD.items()}
    lines: list[tuple[str, ...]] = []
    for name, choices in found.items():
        fits = {pair: one.r2 for pair, one in choices.items() if one.r2 is not None}
        apart = {pair: one.error for pair, one in choices.items() if one.error is not None}
        if apart:
            fit = _mean_and_worst(fits, min, ".3f") if fits else ("-", "-")
            lines.append((methods.get(name, name), *fit, *_mean_and_worst(apart, max, ".3f")))
    return lines


def _translations(group: Group) -> Iterator[tuple[str, list[PairedScore]]]:
    """Yield the scores of each translator, then of each baseline, with a name."""
    for other, method in sorted(
        {(row.method != TRANSLATED, row.method) for _, row in group.scores}
    ):
        rows: dict[str, list[PairedScore]] = {}
        for one, row in group.scores:
            if row.method == method:
                rows.setdefault(one.translator, []).append(row)
        for translator in sorted(rows):
            yield method if other else f"by {translator}", rows[translator]
            # The baselines are the same for all translators.
            if other:
                break


def _field_error(rows: Sequence[PairedScore]) -> float:
    return mean(row.epe_px for row in rows if math.isfinite(row.epe_px))


def _pairs(
    group: Group,
) -> Iterator[tuple[ForceRow, ForceRow | None, ForceRow | None, float | None]]:
    """Yield the rows of each pair: after, before, on own labels; and the Dice score."""
    own = {row.target: row for row in group.rows(TARGET)}
    before = {_pair(row): row for row in group.rows(BEFORE)}
    dice = group.dice(group.best)
    for row in sorted(group.rows(group.after, group.best), key=_in_order):
        score = dice.get((row.source, row.target))
        yield row, before.get(_pair(row)), own.get(row.target), score


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


def _in_order(row: ForceRow) -> tuple[object, ...]:
    return natural_key(row.source), natural_key(row.target)


def _pair(row: ForceRow) -> str:
    return f"{row.source} to {row.target}"
