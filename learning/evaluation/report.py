"""The report of an evaluation: one HTML page with embedded images, and CSV tables."""

import base64
import html
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from learning.errors import LearningError
from learning.evaluation import charts, predictions, translation
from learning.evaluation.distribution import NEIGHBOURS, PERPLEXITY, embedded, mixing_score
from learning.evaluation.predictions import (
    ALL,
    BEFORE,
    SEEN,
    TARGET,
    UNSEEN,
    ForceRow,
    Predictions,
    csv_text,
    force_line,
    force_rows,
    gain_line,
    merged,
    of_role,
    unscored_lines,
    variant_name,
    variants,
)
from learning.evaluation.results_file import read_results
from learning.evaluation.translation import (
    FLOOR,
    METHODS,
    SOURCE,
    TRANSLATED,
    DistanceScore,
    PairedScore,
    TranslationScores,
    paired_rows,
    require_alone,
    score_line,
)
from learning.metrics import axis_means
from recorder.natural_order import natural_key
from recorder.pages import render
from recorder.store import replace_file

# Results of a folder, separated by kind.

RESULTS = "*.npz"
# Seed of t-SNE, and of the choice of presses to plot.
SEED = 0


def read_folder(folder: Path) -> tuple[list[Predictions], list[TranslationScores]]:
    """Read the predictions and translation scores in a folder and its subfolders."""
    forces: list[Predictions] = []
    scores: list[TranslationScores] = []
    for path in sorted(folder.rglob(RESULTS)):
        results = read_results(path)
        if results.kind == predictions.KIND:
            forces.append(predictions.predictions_in(results, path))
        else:
            scores.append(translation.scores_in(results, path))
    return forces, scores


# Forces in the report: errors before and after, compared with the paper, pair by pair.

# Descriptions of roles.
ROLES = {
    UNSEEN: "indenters that the models never saw",
    SEEN: "indenters seen, presses never trained on",
    ALL: "all held-out frames",
}
# Measures that the first table shows of each variant.
GAINS = (
    ("r2_mean", "R2, mean of measured axes"),
    ("mae_fz_n", "MAE Fz [N]"),
    ("mae_shear_n", "MAE shear, mean of Fx and Fy [N]"),
)
# Number of pairs whose sequences are shown, and of presses of each.
SEQUENCES, PRESSES = 3, 10


def _force(predictions: Sequence[Predictions], rows: Sequence[ForceRow]) -> dict[str, Any]:
    """Return the tables and pictures of forces; empty without predictions."""
    if not rows:
        return {}
    role = next((role for role in ROLES if of_role(rows, role)), rows[0].role)
    return {
        "roles": [
            (ROLES.get(name, name), _sentence(rows, name), _gains(of_role(rows, name)))
            for name in dict.fromkeys([role, *ROLES])
            if of_role(rows, name)
        ],
        "transfers": bool(_transfers(rows)),
        "pictures": [*_pictures(of_role(rows, role), role), *_own_picture(predictions, role)],
        "sequences": list(_sequences(predictions, of_role(rows, role), role)),
        "every": [force_line(row) for row in rows],
    }


def _gains(rows: Sequence[ForceRow]) -> dict[str, Any]:
    """Return the coloured table of pairs: its variants, and its lines, the mean first."""
    ways = variants(rows)
    by_pair: dict[tuple[str, str], dict[tuple[str, str], ForceRow]] = {}
    of_target = {row.target: row for row in rows if row.method == TARGET}
    for row in rows:
        if row.method != TARGET:
            by_pair.setdefault((row.source, row.target), {})[row.variant] = row
    if not by_pair:  # only models trained on the target's own labels
        by_pair = {(name, name): {row.variant: row} for name, row in of_target.items()}
    for (_, target), some in by_pair.items():
        if target in of_target:
            some[of_target[target].variant] = of_target[target]
    lines = [(f"mean of {len(by_pair)}", list(by_pair.values()))] if len(by_pair) > 1 else []
    for pair in sorted(by_pair, key=lambda pair: [natural_key(name) for name in pair]):
        lines.append((" to ".join(dict.fromkeys(pair)), [by_pair[pair]]))
    return {
        "ways": ways,
        "lines": [
            (name, [_gain(pairs, way, measure) for measure, _ in GAINS for way in ways])
            for name, pairs in lines
        ],
    }


def _goodness(row: ForceRow, measure: str) -> float:
    """Return 0 to 1: R2 itself; for an error, 1 - 2 x the error over the labels' deviation."""
    if measure.startswith("r2"):
        return row.value(measure)
    fx, fy, fz, _ = row.errors.relative
    relative = fz if measure == "mae_fz_n" else 0.5 * (fx + fy)
    return 1 - 2 * relative


def _gain(
    pairs: Sequence[dict[tuple[str, str], ForceRow]], way: tuple[str, str], measure: str
) -> tuple[float, float] | None:
    """Return the means of a measure and of its goodness; None if no pair has the variant."""
    rows = [some[way] for some in pairs if way in some]
    if not rows:
        return None
    # Pairs without a label on an axis have no error there.
    of = np.array([(row.value(measure), _goodness(row, measure)) for row in rows])
    value, goodness = axis_means(of).tolist()
    return value, goodness


def _sentence(rows: Sequence[ForceRow], role: str) -> str:
    frames = max(row.errors.frames for row in of_role(rows, role))
    gained = gain_line(rows, role).replace("  ", "; ")
    return f"On {ROLES.get(role, role)}, up to {frames:,} frames a pair: {gained}."


def _pictures(rows: Sequence[ForceRow], role: str) -> Iterator[tuple[str, str]]:
    """Yield pictures of all pairs, encoded in base 64, with their texts."""
    transfers = _transfers(rows)
    by_way = {way: [row for row in transfers if row.variant == way] for way in variants(transfers)}
    own = [row for row in rows if row.method == TARGET]
    name = ROLES.get(role, role)
    if by_way:
        for measure, title, good in (
            ("r2_mean", f"R2, mean of axes; {name}", "high"),
            ("mae_fz_n", f"MAE Fz [N]; {name}", "low"),
            ("mae_shear_n", f"MAE shear [N]; {name}", "low"),
        ):
            yield _encoded(charts.heatmaps(by_way, measure, title, good, own=own)), title
    before = next((some for way, some in by_way.items() if way[0] == BEFORE), [])
    for way, some in by_way.items():
        if way[0] != BEFORE:
            names = BEFORE, variant_name(way)
            drawn = charts.radar(before, some, names)
            yield _encoded(drawn), f"errors of all pairs, {names[1]}"


def _own_picture(predictions: Sequence[Predictions], role: str) -> Iterator[tuple[str, str]]:
    """Yield predicted over true forces of each model that learned its sensor's own labels."""
    for one in predictions:
        held = one.only(_held(one, role))
        if one.method == TARGET and len(held):
            text = f"{one.target}: predicted over true forces; {ROLES.get(role, role)}"
            yield _encoded(charts.predicted_over_true(held)), text


def _encoded(png: bytes) -> str:
    return base64.b64encode(png).decode()


def _transfers(rows: Sequence[ForceRow]) -> list[ForceRow]:
    """Return the rows of transferred models, in one order of pairs for all pictures."""
    transfers = [row for row in rows if row.method != TARGET]
    return sorted(transfers, key=lambda row: (row.source, row.target))


def _sequences(
    predictions: Sequence[Predictions], rows: Sequence[ForceRow], role: str
) -> Iterator[tuple[str, str]]:
    """Yield the sequences of the worst, the median and the best pair, by R2 after."""
    transfers = _transfers(rows) or list(rows)
    after = [row for row in transfers if row.method != BEFORE] or transfers
    score: dict[tuple[str, str], float] = {}
    for row in after:
        pair = row.source, row.target
        score[pair] = max(score.get(pair, -np.inf), row.errors.r2_mean)
    pairs = sorted(score, key=lambda pair: score[pair])
    indices = np.unique(np.linspace(0, len(pairs) - 1, SEQUENCES).round().astype(int))
    for source, target in [pairs[index] for index in indices if pairs]:
        plotted = [one for one in predictions if (one.source, one.target) == (source, target)]
        plotted = [one.only(_held(one, role)) for one in plotted]
        plotted = sorted((one for one in plotted if len(one)), key=lambda one: one.method != BEFORE)
        if plotted:
            names = " to ".join(dict.fromkeys((source, target)))
            text = f"{names}: R2 {score[source, target]:.3f} at best"
            yield _encoded(charts.sequences(plotted, PRESSES, SEED)), text


def _held(one: Predictions, role: str) -> Any:
    return np.isin(one.role, (UNSEEN, SEEN)) if role == ALL else one.role == role


def _column(name: str) -> str:
    text = name.replace("mae_", "MAE ").replace("r2_", "R2 ").replace("_over_std", " /std")
    return text.replace("_n", " [N]") if name.startswith("mae_") else text


# Translated frames in the report: scores next to baselines and lower bound, and features.

# Maximum number of pairs whose features are plotted, the best and the worst mixing included.
DRAWN = 4


def _translation(scores: Sequence[TranslationScores]) -> dict[str, Any]:
    """Return the tables and the picture of translations; empty without scores."""
    if not scores:
        return {}
    drawn = _drawn(scores)
    return {
        "paired": _paired(scores),
        "distances": list(_distances(scores)),
        "neighbours": NEIGHBOURS,
        "embeddings": _encoded(_embeddings(drawn)) if drawn else "",
        "perplexity": PERPLEXITY,
    }


def _paired(scores: Sequence[TranslationScores]) -> list[tuple[TranslationScores, PairedScore]]:
    rows = sorted(
        paired_rows(scores),
        key=lambda each: (each[0].source, each[0].target, each[0].translator, _order(each[1])),
    )
    return [each for each in rows if each[1].method != FLOOR or not math.isnan(each[1].epe_px)]


def _distances(
    scores: Sequence[TranslationScores],
) -> Iterator[tuple[TranslationScores, DistanceScore, float]]:
    """Yield the distances, and how many times smaller Frechet's is than before."""
    for one in scores:
        before = {r.role + r.extractor: r.frechet for r in one.distances if r.method == SOURCE}
        for row in sorted(one.distances, key=_order):
            was = before.get(row.role + row.extractor, math.nan)
            yield one, row, was / row.frechet if row.frechet else math.inf


def _order(row: PairedScore | DistanceScore) -> tuple[str, int]:
    return row.role, METHODS.index(row.method)


def _drawn(scores: Sequence[TranslationScores]) -> list[TranslationScores]:
    having = [one for one in scores if {SOURCE, TRANSLATED, FLOOR} <= set(one.features)]
    having = [one for one in having if min(len(f) for f in one.features.values()) >= NEIGHBOURS]
    having.sort(key=lambda one: _mixing(one, TRANSLATED))
    indices = np.unique(np.linspace(0, len(having) - 1, DRAWN).round().astype(int))
    return [having[index] for index in indices if having]


def _mixing(one: TranslationScores, method: str) -> float:
    real = one.features[FLOOR].astype(np.float64)
    return mixing_score(real, one.features[method].astype(np.float64))


def _embeddings(scores: Sequence[TranslationScores]) -> bytes:
    panels, names = [], []
    for one in scores:
        for method in (SOURCE, TRANSLATED):
            real, other = one.features[FLOOR], one.features[method]
            points = embedded(np.concatenate([real, other]).astype(np.float64), seed=SEED)
            title = f"{one.source} to {one.target}, {method}: mixing {_mixing(one, method):.2f}"
            panels.append((title, points[: len(real)], points[len(real) :]))
            names.append((f"real {one.target}", method))
    return charts.embeddings(panels, 2 if len(scores) == 1 else 4, names)


# File names of a report.
PAGE, FORCE, UNSCORED = "report.html", "force.csv", "unscored.csv"
PAIRED, DISTANCES = "translation.csv", "distances.csv"


@dataclass(frozen=True, slots=True)
class Report:
    """Files and results of a report."""

    files: tuple[Path, ...]
    """The page first, then the tables."""
    force: tuple[ForceRow, ...]
    unscored: tuple[dict[str, Any], ...]
    """Lines on predictions without labels, see `unscored_lines`."""

    @property
    def lines(self) -> tuple[str, ...]:
        """R2 before and after by role, unseen indenters last; then targets without labels."""
        roles = [role for role in (ALL, SEEN, UNSEEN) if of_role(self.force, role)]
        scored = tuple(f"{role}: {gain_line(self.force, role)}" for role in roles)
        axes: dict[str, list[str]] = {}
        for line in self.unscored:
            axes.setdefault(line["target"], []).append(line["axis"])
        return scored + tuple(
            f"{target}: no label of {', '.join(dict.fromkeys(some))}; predictions are not scored"
            for target, some in axes.items()
        )


def write_report(
    predictions: Sequence[Predictions],
    scores: Sequence[TranslationScores],
    out: Path,
    *,
    title: str = "What was gained",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Report:
    """Write the report of predictions and translation scores, either of which may be empty.

    Files of an earlier report are replaced.
    """
    if not predictions and not scores:
        raise LearningError("evaluate: found neither predictions nor translation scores")
    require_alone(scores)
    pooled = merged(predictions)
    rows, unscored = force_rows(pooled), unscored_lines(pooled)
    force = _force(pooled, rows)
    progress(1, 3)
    translated = _translation(scores)
    progress(2, 3)
    page = render(
        Path(__file__).with_suffix(".html"),
        title=title,
        summary=_summary(pooled, scores),
        escaped=lambda text: html.escape(str(text).strip()),
        measures=GAINS,
        variant_name=variant_name,
        column=_column,
        floor=FLOOR,
        force=force,
        unscored=unscored,
        translation=translated,
        seed=SEED,
    )
    tables: dict[str, list[dict[str, Any]]] = {
        FORCE: [force_line(row) for row in rows],
        UNSCORED: unscored,
        PAIRED: [score_line(one, row) for one, row in paired_rows(scores)],
        DISTANCES: [score_line(one, row) for one in scores for row in one.distances],
    }
    out.mkdir(parents=True, exist_ok=True)
    files = [out / PAGE]
    replace_file(out / PAGE, page.encode())
    for name, lines in tables.items():
        if lines:
            replace_file(out / name, csv_text(lines).encode())
            files.append(out / name)
        else:
            (out / name).unlink(missing_ok=True)
    progress(3, 3)
    return Report(tuple(files), rows, tuple(unscored))


def _summary(predictions: Sequence[Predictions], scores: Sequence[TranslationScores]) -> str:
    reported = []
    if predictions:
        pairs = {(one.source, one.target) for one in predictions}
        frames = sum(len(one) for one in predictions)
        if all(one.method == TARGET for one in predictions):
            reported.append(f"{', '.join(sorted(one.target for one in predictions))}: own labels")
        else:
            models = f"{len(predictions)} force model{'s' * (len(predictions) > 1)}"
            reported.append(f"{len(pairs)} pair{'s' * (len(pairs) > 1)} of sensors by {models}")
        reported.append(f"{frames:,} predicted forces")
    if scores:
        reported.append(f"{len({(one.source, one.target) for one in scores})} pairs translated")
    return f"{', '.join(reported)}."
