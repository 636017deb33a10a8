"""The report of an evaluation: one HTML page with its pictures in it, and CSV tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from learning.errors import LearningError
from learning.evaluation import force_section, translation_section
from learning.evaluation.force_table import (
    ALL,
    SEEN,
    UNSEEN,
    ForceRow,
    csv_text,
    force_line,
    force_rows,
    gain_line,
    of_role,
)
from learning.evaluation.html_page import page, paragraph
from learning.evaluation.paper_figures import Beside, beside_the_paper
from learning.evaluation.predictions import Predictions, merged
from learning.evaluation.translation_scores import (
    TranslationScores,
    paired_rows,
    require_alone,
    score_line,
)
from recorder.store.durable import replace_file

PAGE, FORCE, PAIRED, DISTANCES, PAPER = (
    "report.html",
    "force.csv",
    "translation.csv",
    "distances.csv",
    "paper.csv",
)
"""Files of a report."""


@dataclass(frozen=True, slots=True)
class Report:
    """What was written."""

    files: tuple[Path, ...]
    """The page first, then the tables that there are."""
    force: tuple[ForceRow, ...]
    """Errors of forces."""
    beside: tuple[Beside, ...]
    """The paper's figures, and ours."""

    @property
    def lines(self) -> tuple[str, ...]:
        """R2 before and after, a line for each role there is; unseen indenters last."""
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
        out: Folder of the report; files of an earlier one are replaced.
        title: Title of the page.
        seed: Of t-SNE, and of the presses that are shown.
        progress: Called with the parts that are done and those there are.

    Raises:
        LearningError: Nothing to report, a frame predicted twice, or a score given twice.
        OSError: Not writable.
    """
    if not predictions and not scores:
        raise LearningError("evaluate: found neither predictions nor translation scores")
    require_alone(scores)
    together = merged(predictions)
    rows = force_rows(together)
    beside = beside_the_paper(rows)
    parts = [paragraph(_summary(together, scores))]
    parts += force_section.parts(together, rows, beside, seed=seed)
    progress(1, 3)
    parts += translation_section.parts(scores, seed=seed)
    progress(2, 3)
    tables: dict[str, list[dict[str, Any]]] = {
        FORCE: [force_line(row) for row in rows],
        PAIRED: [score_line(one, row) for one, row in paired_rows(scores)],
        DISTANCES: [score_line(one, row) for one in scores for row in one.distances],
        PAPER: [force_section.beside_line(one) for one in beside],
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
    said = []
    if predictions:
        pairs = {(one.source, one.target) for one in predictions}
        frames = sum(len(one) for one in predictions)
        said.append(f"{len(pairs)} pairs of sensors by {len(predictions)} force models")
        said.append(f"{frames:,} predicted forces")
    if scores:
        said.append(f"{len({(one.source, one.target) for one in scores})} pairs translated")
    return f"{', '.join(said)}."
