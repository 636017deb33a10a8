"""What an experiment with a group of sensors found, on indenters that no model saw."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from learning.errors import LearningError
from learning.evaluation import predictions as predicted
from learning.evaluation.force_table import UNSEEN, ForceRow, force_rows, of_role
from learning.evaluation.paper_figures import Beside, beside_the_paper
from learning.evaluation.results_file import read_results
from learning.evaluation.translation_scores import PairedScore, paired_rows, scores_in

NO_TRANSLATOR = ""

Scored = tuple[str, str, str, PairedScore]
"""Source, target, translator, and their score."""


@dataclass(frozen=True, slots=True)
class Group:
    """What an experiment found, on indenters that no model saw."""

    name: str
    """How it is called."""
    force: tuple[ForceRow, ...]
    """Errors of force on unseen indenters."""
    beside: tuple[Beside, ...]
    """The paper's figures, and ours."""
    scores: tuple[Scored, ...]
    """Translated frames, and what they are held against, on unseen indenters."""

    @property
    def pairs(self) -> int:
        """How many pairs of sensors."""
        return len({(row.source, row.target) for row in self.force if row.source != row.target})

    @property
    def after(self) -> str:
        """The last method that needs no label of the target."""
        methods = {row.method for row in self.force}
        return "compensated" if "compensated" in methods else "transferred"

    def rows(self, method: str, translator: str = NO_TRANSLATOR) -> list[ForceRow]:
        """The rows of one variant."""
        return [row for row in self.force if row.variant == (method, translator)]

    @property
    def best(self) -> str:
        """The translator by which the forces are told best."""
        names = {row.translator for row in self.force if row.method == self.after}
        if not names:
            raise LearningError(f"{self.name}: found no {self.after} forces; allowed: some")
        return max(
            names, key=lambda name: mean(row.errors.r2_mean for row in self.rows(self.after, name))
        )


def read_group(name: str, folder: Path) -> Group:
    """Return what an experiment's folder holds, whether it has come to its end or not.

    Raises:
        LearningError: No results, or a damaged file of them.
    """
    paths = sorted((folder / "results").glob("*.npz"))
    if not paths:
        raise LearningError(f"{folder}: found no results; allowed: the folder of an experiment")
    forces, scores = [], []
    for path in paths:
        results = read_results(path)
        if results.kind == predicted.KIND:
            forces.append(predicted.predictions_in(results, path))
        else:
            scores.append(scores_in(results, path))
    rows = force_rows(predicted.merged(forces))
    scored = [(one.source, one.target, one.translator, row) for one, row in paired_rows(scores)]
    return Group(
        name,
        of_role(rows, UNSEEN),
        beside_the_paper(rows),
        tuple(one for one in scored if one[3].role == UNSEEN),
    )


def mean(values: Iterable[float]) -> float:
    """Return the mean; NaN of nothing."""
    found = list(values)
    return sum(found) / len(found) if found else float("nan")
