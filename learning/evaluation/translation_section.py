"""What the report says of translated frames: scores beside baselines and floor, and features."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from learning.evaluation import charts
from learning.evaluation.html_page import Cell, graded, heading, note, number, picture, table
from learning.evaluation.translation_scores import (
    FLOOR,
    METHODS,
    SOURCE,
    TRANSLATED,
    DistanceScore,
    PairedScore,
    TranslationScores,
    paired_rows,
)
from learning.evaluation.two_samples import NEIGHBOURS, PERPLEXITY, embedded, mixing_score

DRAWN = 4
"""Pairs whose features are drawn at most, those of the best and the worst mixing among them."""

_PAIRED = """Each frame beside the target's real frame of the same press and phase (location
pairs: the last frame of each phase, so that a quarter of them are nearly unloaded). Markers:
median and 95th percentile of the distance of markers that are each other's nearest. Count:
share of frames with more or fewer markers. Area: mean of |marker area / true area - 1|. EPE:
mean distance of markers from where the simulator's displacement takes them; of real frames it
is what the measure itself misses. Baselines: the source's frame as it is; the target's
untouched reference; the target's training frame of nearest commanded position and depth in the
same phase."""
_DISTANCES = """Real frames of one half of the locations beside what is judged, of the other
half; for the floor, real frames of the other half. Frechet and kernel distance are named by
what made the features; FID and KID are those of Inception only. Classifier: accuracy of a
logistic regression that tells the two apart, 5 folds; 0.5 is chance. Mixing: share of {k}
nearest neighbours from the other set over that of chance; 1 is fully mixed. Drop: how many
times smaller Frechet's distance is than before (the paper: about 100 in simulation, 50 and more
between real GelSights, by Inception on 10,000 images). A distance near the floor's is as small
as it gets with so many images."""


def parts(scores: Sequence[TranslationScores], *, seed: int) -> list[str]:
    """Return the parts of the page; none without scores."""
    if not scores:
        return []
    written = [heading("Translated frames beside true ones"), note(_PAIRED), _paired(scores)]
    if any(one.distances for one in scores):
        written += [
            heading("Distances of features"),
            note(_DISTANCES.format(k=NEIGHBOURS)),
            _distances(scores),
        ]
    drawn = _drawn(scores)
    if drawn:
        perplexity = f"{PERPLEXITY:g}, or a third of the samples"
        text = f"t-SNE of the same features, seed {seed}, perplexity {perplexity}."
        written += [note(text), picture(_embeddings(drawn, seed), text)]
    return written


def _paired(scores: Sequence[TranslationScores]) -> str:
    columns = ["pair", "translator", "role", "frames of", "pairs", "Dice", "IoU", "markers [px]"]
    columns += ["95 % [px]", "markers [mm]", "count [%]", "area [%]", "EPE [px]", "EPE [mm]"]
    lines: list[list[Cell | str]] = []
    for one, row in sorted(paired_rows(scores), key=lambda each: (_name(each[0]), _order(each[1]))):
        if row.method != FLOOR or not math.isnan(row.epe_px):
            lines.append([*_named(one, row), Cell(f"{row.frames:,}"), *_paired_cells(row)])
    return table(columns, lines)


def _paired_cells(row: PairedScore) -> list[Cell]:
    if row.method == FLOOR:  # of a frame beside itself, only the simulator's truth says something
        blank = [Cell("")] * 7
        return [*blank, number(row.epe_px), number(row.epe_mm, 3)]
    # Below 0.8, a Dice is no better than that of the untouched reference in most pairs.
    return [
        graded(row.dice, (row.dice - 0.8) / 0.2, 3),
        number(row.iou, 3),
        number(row.centroid_px),
        number(row.centroid_p95_px),
        number(row.centroid_mm, 3),
        number(100 * row.count_mismatch, 1),
        number(100 * row.area_ratio_error, 1),
        number(row.epe_px),
        number(row.epe_mm, 3),
    ]


def _distances(scores: Sequence[TranslationScores]) -> str:
    lines: list[list[Cell | str]] = []
    for one in scores:
        before = {r.role + r.extractor: r.frechet for r in one.distances if r.method == SOURCE}
        for row in sorted(one.distances, key=_order):
            was = before.get(row.role + row.extractor, math.nan)
            drop = was / row.frechet if row.frechet else math.inf
            lines.append(
                [
                    *_named(one, row),
                    _measure(row),
                    Cell(f"{row.samples:,}"),
                    number(row.frechet, 4),
                    number(drop, 1),
                    number(row.kernel, 5),
                    number(row.kernel_std, 5),
                    graded(row.classifier, 2 - 2 * row.classifier, 3),
                    graded(row.mixing, row.mixing, 2),
                ]
            )
    columns = ["pair", "translator", "role", "frames of", "named", "images", "Frechet", "drop"]
    return table([*columns, "kernel", "+-", "classifier", "mixing"], lines)


def _measure(row: DistanceScore) -> str:
    """Return what the distances are called."""
    if row.extractor.startswith("inception@"):
        return f"FID, KID [{row.extractor}]"
    return f"frechet, kernel [{row.extractor}]"


def _named(one: TranslationScores, row: PairedScore | DistanceScore) -> list[str]:
    return [*_name(one), row.role, row.method]


def _name(one: TranslationScores) -> tuple[str, str]:
    return f"{one.source} to {one.target}", one.translator


def _order(row: PairedScore | DistanceScore) -> tuple[str, int]:
    return row.role, METHODS.index(row.method)


def _drawn(scores: Sequence[TranslationScores]) -> list[TranslationScores]:
    having = [one for one in scores if {SOURCE, TRANSLATED, FLOOR} <= set(one.features)]
    having = [one for one in having if min(len(f) for f in one.features.values()) >= NEIGHBOURS]
    having.sort(key=lambda one: _mixing(one, TRANSLATED))
    places = np.unique(np.linspace(0, len(having) - 1, DRAWN).round().astype(int))
    return [having[place] for place in places if having]


def _mixing(one: TranslationScores, method: str) -> float:
    real = one.features[FLOOR].astype(np.float64)
    return mixing_score(real, one.features[method].astype(np.float64))


def _embeddings(scores: Sequence[TranslationScores], seed: int) -> bytes:
    panels, names = [], []
    for one in scores:
        for method in (SOURCE, TRANSLATED):
            real, other = one.features[FLOOR], one.features[method]
            places = embedded(np.concatenate([real, other]).astype(np.float64), seed=seed)
            title = f"{one.source} to {one.target}, {method}: mixing {_mixing(one, method):.2f}"
            panels.append((title, places[: len(real)], places[len(real) :]))
            names.append((f"real {one.target}", method))
    return charts.embeddings(panels, 2 if len(scores) == 1 else 4, names)
