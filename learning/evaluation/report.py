"""The report of an evaluation: one HTML page with embedded images, and CSV tables."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from learning.errors import LearningError
from learning.evaluation import charts, predictions, translation
from learning.evaluation.distribution import NEIGHBOURS, PERPLEXITY, embedded, mixing_score
from learning.evaluation.paper_figures import Beside, beside_the_paper
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
from recorder.store import replace_file
from recorder.strict_yaml import natural_key

# Results of a folder, separated by kind.

RESULTS = "*.npz"


def read_folder(folder: Path) -> tuple[list[Predictions], list[TranslationScores]]:
    """Read the predictions and translation scores in a folder and its subfolders.

    Raises:
        LearningError: A file is corrupt.
    """
    found: tuple[list[Predictions], list[TranslationScores]] = [], []
    for path in sorted(folder.rglob(RESULTS)):
        results = read_results(path)
        if results.kind == predictions.KIND:
            found[0].append(predictions.predictions_in(results, path))
        else:
            found[1].append(translation.scores_in(results, path))
    return found


# A self-contained HTML page: headings, paragraphs, coloured tables, images.

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #262a33; max-width: 1180px; margin: 2em auto;
  padding: 0 1em; }
h1 { font-size: 1.6em; }
h2 { font-size: 1.25em; margin-top: 2em; border-bottom: 1px solid #e2e5ea; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13px; }
th, td { padding: 3px 9px; border: 1px solid #e2e5ea; text-align: right; }
th { background: #f7f8fa; font-weight: 600; } td.name, th.name { text-align: left; }
tr.mean td { font-weight: 600; border-bottom: 2px solid #9aa1ad; }
.wide { overflow-x: auto; } img { max-width: 100%; } p.note { color: #646b78; font-size: 13px; }
details { margin: 1em 0; } summary { cursor: pointer; color: #3b6fb6; }
"""


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell of a table."""

    text: str
    """Its text."""
    goodness: float | None = None
    """Colour from 0, red, through yellow to 1, green; None: white."""


def number(value: float, digits: int = 2) -> Cell:
    """Return a cell with a number, or a dash for NaN."""
    return Cell("-" if math.isnan(value) else f"{value:.{digits}f}")


def graded(value: float, goodness: float, digits: int = 2) -> Cell:
    """Return a cell with a number and a colour, or a dash for NaN."""
    if math.isnan(value):
        return Cell("-")
    return Cell(f"{value:.{digits}f}", None if math.isnan(goodness) else goodness)


def page(title: str, parts: Sequence[str]) -> str:
    """Return the HTML of the page."""
    body = "\n".join(parts)
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head>\n<body>\n"
        f"<h1>{html.escape(title)}</h1>\n{body}\n</body></html>\n"
    )


def heading(text: str) -> str:
    """Return the HTML of a heading."""
    return f"<h2>{html.escape(text)}</h2>"


def paragraph(text: str) -> str:
    """Return the HTML of a paragraph."""
    return f"<p>{html.escape(text)}</p>"


def note(text: str) -> str:
    """Return the HTML of a paragraph in small print."""
    return f'<p class="note">{html.escape(text)}</p>'


def folded(summary: str, content: str) -> str:
    """Return the HTML of content that is shown on a click on its summary."""
    return f"<details><summary>{html.escape(summary)}</summary>\n{content}\n</details>"


def picture(png: bytes, reported: str) -> str:
    """Return the HTML of an embedded image."""
    data = base64.b64encode(png).decode()
    return (
        f'<p><img alt="{html.escape(reported, quote=True)}" src="data:image/png;base64,{data}"></p>'
    )


def table(
    columns: Sequence[str],
    rows: Sequence[Sequence[Cell | str]],
    *,
    groups: Sequence[tuple[str, int]] = (),
    first_is_mean: bool = False,
) -> str:
    """Return the HTML of a table.

    Args:
        columns: Names of the columns.
        rows: Cells of each row; plain text is aligned to the left.
        groups: Headings above the columns: text, and number of columns.
        first_is_mean: True if the first row is the mean of the others and is emphasised.
    """
    lines = ['<div class="wide"><table>']
    if groups:
        cells = (f'<th colspan="{count}">{html.escape(text)}</th>' for text, count in groups)
        lines.append(f"<tr>{''.join(cells)}</tr>")
    lines.append("<tr>" + "".join(f"<th>{html.escape(name)}</th>" for name in columns) + "</tr>")
    for place, row in enumerate(rows):
        kind = ' class="mean"' if first_is_mean and place == 0 else ""
        lines.append(f"<tr{kind}>" + "".join(_cell(cell) for cell in row) + "</tr>")
    return "\n".join([*lines, "</table></div>"])


def _cell(cell: Cell | str) -> str:
    if isinstance(cell, str):
        return f'<td class="name">{html.escape(cell)}</td>'
    if cell.goodness is None:
        return f"<td>{html.escape(cell.text)}</td>"
    return f'<td style="background:{_colour(cell.goodness)}">{html.escape(cell.text)}</td>'


def _colour(goodness: float) -> str:
    """Return a pale colour between red, yellow and green."""
    share = min(max(goodness, 0.0), 1.0)
    # Hue 0 is red, 60 yellow, 120 green.
    return f"hsl({120 * share:.0f} 75% 82%)"


# Forces in the report: errors before and after, compared with the paper, pair by pair.

# Descriptions of roles.
ROLES = {
    UNSEEN: "indenters that the models never saw",
    SEEN: "indenters seen, presses never trained on",
    ALL: "all held-out frames",
}
# Measures that the first table shows of each variant.
GAINS = (
    ("r2_mean", "R2, mean of Fx, Fy, Fz"),
    ("mae_fz_n", "MAE Fz [N]"),
    ("mae_shear_n", "MAE shear, mean of Fx and Fy [N]"),
)
# Number of pairs whose sequences are shown, and of presses of each.
SEQUENCES, PRESSES = 3, 10

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


def force_parts(
    predictions: Sequence[Predictions],
    rows: Sequence[ForceRow],
    beside: Sequence[Beside],
    *,
    seed: int,
) -> list[str]:
    """Return the parts of the page on forces; empty without predictions."""
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
    """Return the coloured table of pairs, one column per variant and the mean in the first row."""
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
    """Return a figure of the paper and our value as a line of the CSV."""
    figure = asdict(one.figure)
    figure["pair"] = " to ".join(one.figure.pair) if one.figure.pair else ""
    ours = {key: value for key, value in asdict(one).items() if key != "figure"}
    return {**figure, **ours}


def _goodness(row: ForceRow, measure: str) -> float:
    """Return 0 to 1: R2 itself; for an error, 1 - 2 x the error over the labels' deviation."""
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
    """Return the sequences of the worst, the median and the best pair, by R2 after."""
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
        reported = force_line(row)
        texts = [
            str(reported[name]) for name in ("source", "target", "method", "translator", "role")
        ]
        values = list(reported.values())[len(texts) + 1 :]
        lines.append(
            [*texts, Cell(f"{reported['frames']:,}"), *(number(value, 3) for value in values)]
        )
    names = [_column(name) for name in force_line(rows[0])]
    return table(names, lines)


def _column(name: str) -> str:
    text = name.replace("mae_", "MAE ").replace("r2_", "R2 ").replace("_over_std", " /std")
    return text.replace("_n", " [N]") if name.startswith("mae_") else text


# Translated frames in the report: scores next to baselines and lower bound, and features.

# Maximum number of pairs whose features are plotted, the best and the worst mixing included.
DRAWN = 4

_PAIRED = """Each frame beside the target's real frame of the same press and phase (location
pairs: the last frame of each phase, so that a quarter of them are nearly unloaded). SSIM:
structural similarity of the images of 256 x 256 that networks see. Markers:
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


def translation_parts(scores: Sequence[TranslationScores], *, seed: int) -> list[str]:
    """Return the parts of the page on translations; empty without scores."""
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
    columns = ["pair", "translator", "role", "frames of", "pairs", "Dice", "IoU", "SSIM"]
    columns += ["markers [px]", "95 % [px]", "markers [mm]", "count [%]", "area [%]"]
    columns += ["EPE [px]", "EPE [mm]"]
    lines: list[list[Cell | str]] = []
    for one, row in sorted(paired_rows(scores), key=lambda each: (_name(each[0]), _order(each[1]))):
        if row.method != FLOOR or not math.isnan(row.epe_px):
            lines.append([*_named(one, row), Cell(f"{row.frames:,}"), *_paired_cells(row)])
    return table(columns, lines)


def _paired_cells(row: PairedScore) -> list[Cell]:
    if row.method == FLOOR:  # compared with itself: only the EPE is meaningful
        blank = [Cell("")] * 8
        return [*blank, number(row.epe_px), number(row.epe_mm, 3)]
    # Below 0.8, a Dice is no better than that of the reference without contact in most pairs.
    return [
        graded(row.dice, (row.dice - 0.8) / 0.2, 3),
        number(row.iou, 3),
        number(row.ssim, 3),
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
    """Return the name of the distances."""
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


# File names of a report.
PAGE, FORCE, PAIRED, DISTANCES, PAPER = (
    "report.html",
    "force.csv",
    "translation.csv",
    "distances.csv",
    "paper.csv",
)


@dataclass(frozen=True, slots=True)
class Report:
    """Files and results of a report."""

    files: tuple[Path, ...]
    """The page first, then the tables."""
    force: tuple[ForceRow, ...]
    """Errors of forces."""
    beside: tuple[Beside, ...]
    """The paper's figures, with our values."""

    @property
    def lines(self) -> tuple[str, ...]:
        """R2 before and after, a line for each role that exists; unseen indenters last."""
        roles = [role for role in (ALL, SEEN, UNSEEN) if of_role(self.force, role)]
        return tuple(f"{role}: {gain_line(self.force, role)}" for role in roles)


def write_report(
    predictions: Sequence[Predictions],
    scores: Sequence[TranslationScores],
    out: Path,
    *,
    title: str = "What was gained",
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Report:
    """Write the report of predictions and translation scores, either of which may be empty.

    Args:
        predictions: Predicted forces, of any pairs, methods and translators.
        scores: Scores of translated frames.
        out: Folder of the report; files of an earlier report are replaced.
        title: Title of the page.
        seed: Seed of t-SNE, and of the choice of presses to plot.
        progress: Called with the number of parts done and in total.

    Raises:
        LearningError: There is nothing to report, a frame is predicted twice, or a score is given
            twice.
        OSError: The folder is not writable.
    """
    if not predictions and not scores:
        raise LearningError("evaluate: found neither predictions nor translation scores")
    require_alone(scores)
    together = merged(predictions)
    rows = force_rows(together)
    beside = beside_the_paper(rows)
    parts = [paragraph(_summary(together, scores))]
    parts += force_parts(together, rows, beside, seed=seed)
    progress(1, 3)
    parts += translation_parts(scores, seed=seed)
    progress(2, 3)
    tables: dict[str, list[dict[str, Any]]] = {
        FORCE: [force_line(row) for row in rows],
        PAIRED: [score_line(one, row) for one, row in paired_rows(scores)],
        DISTANCES: [score_line(one, row) for one in scores for row in one.distances],
        PAPER: [beside_line(one) for one in beside],
    }
    out.mkdir(parents=True, exist_ok=True)
    files = [out / PAGE]
    replace_file(out / PAGE, page(title, parts).encode())
    for name, lines in tables.items():
        if lines:
            replace_file(out / name, csv_text(lines).encode())
            files.append(out / name)
        else:
            (out / name).unlink(missing_ok=True)
    progress(3, 3)
    return Report(tuple(files), rows, beside)


def _summary(predictions: Sequence[Predictions], scores: Sequence[TranslationScores]) -> str:
    reported = []
    if predictions:
        pairs = {(one.source, one.target) for one in predictions}
        frames = sum(len(one) for one in predictions)
        reported.append(f"{len(pairs)} pairs of sensors by {len(predictions)} force models")
        reported.append(f"{frames:,} predicted forces")
    if scores:
        reported.append(f"{len({(one.source, one.target) for one in scores})} pairs translated")
    return f"{', '.join(reported)}."
