"""What an experiment with a group of sensors found, on indenters that no model saw."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.learning.tables.by_indenter import IndenterErrors, Variant, by_indenter
from learning.compensation import StoredCompensation, read_stored
from learning.errors import LearningError
from learning.evaluation.paper_figures import Beside, beside_the_paper
from learning.evaluation.predictions import (
    CHOICES,
    UNSEEN,
    ForceRow,
    after,
    force_rows,
    merged,
    of_role,
)
from learning.evaluation.report import read_folder
from learning.evaluation.translation import TRANSLATED, PairedScore, TranslationScores, paired_rows

NO_TRANSLATOR = ""

Scored = tuple[TranslationScores, PairedScore]
"""A row of scores, and whose they are."""


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
    labels: StoredCompensation | None = None
    """How labels were brought from skin to skin; None: they were not."""
    indenters: Mapping[Variant, tuple[IndenterErrors, ...]] = field(default_factory=dict)
    """The same errors by indenter, those of the largest forces first."""

    @property
    def pairs(self) -> int:
        """How many pairs of sensors."""
        return len({(row.source, row.target) for row in self.force if row.source != row.target})

    @property
    def after(self) -> str:
        """The last method that needs no label of the target."""
        return after({row.method for row in self.force})

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

    def label_fits(self) -> list[float]:
        """Return R2 of the labels that were learned from, were they the target's; by pair."""
        if self.labels is None:
            return []
        name = CHOICES.get(self.after)
        pairs = self.labels.pairs
        chosen = [pair.choices.get(name) if name else pair.before for pair in pairs]
        return [one.r2 for one in chosen if one is not None and one.r2 is not None]

    def dice(self, translator: str) -> dict[tuple[str, str], float]:
        """Dice of the frames that a translator made, by source and target."""
        return {
            (one.source, one.target): row.dice
            for one, row in self.scores
            if one.translator == translator and row.method == TRANSLATED
        }


def read_group(name: str, folder: Path) -> Group:
    """Return what an experiment's folder holds, whether it has come to its end or not.

    Raises:
        LearningError: No results, or a damaged file of them.
    """
    forces, scores = read_folder(folder / "results")
    if not forces and not scores:
        raise LearningError(f"{folder}: found no results; allowed: the folder of an experiment")
    predictions = merged(forces)
    rows = force_rows(predictions)
    return Group(
        name,
        of_role(rows, UNSEEN),
        beside_the_paper(rows),
        tuple((one, row) for one, row in paired_rows(scores) if row.role == UNSEEN),
        read_stored(stored) if (stored := folder / "compensation.json").is_file() else None,
        by_indenter(predictions),
    )


def mean(values: Iterable[float]) -> float:
    """Return the mean; NaN of nothing."""
    found = list(values)
    return sum(found) / len(found) if found else float("nan")
