"""Results of an experiment with a group of sensors, on indenters that no model saw."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.learning.tables.paper_figures import Beside, beside_the_paper
from learning.compensation.fit import CHOICE_OF_METHOD, StoredCompensation, read_stored
from learning.compensation.simulated import SIMULATED
from learning.errors import LearningError
from learning.evaluation.predictions import (
    UNSEEN,
    ForceRow,
    Predictions,
    after,
    force_rows,
    merged,
    of_role,
)
from learning.evaluation.report import read_folder
from learning.evaluation.translation import TRANSLATED, PairedScore, TranslationScores, paired_rows
from learning.metrics import force_errors, r_squared
from recorder.natural_order import natural_key

NO_TRANSLATOR = ""

# Scores of a translator, and the row of scores they contain.
Scored = tuple[TranslationScores, PairedScore]


# Method and translator.
Variant = tuple[str, str]


@dataclass(frozen=True, slots=True)
class IndenterErrors:
    """Errors on frames of one indenter; means over pairs."""

    indenter: str
    """Name of the indenter."""
    reach: float
    """Largest normal force of the labels, in any sensor [N]."""
    shear: float
    """Mean absolute error of Fx and Fy [N]."""
    normal: float
    """Mean absolute error of Fz [N]."""
    r2_of_others: float
    """R2 of all unseen indenters but this one, mean over axes; NaN where there is no other."""


@dataclass(frozen=True, slots=True)
class Group:
    """Results of an experiment, on indenters that no model saw."""

    name: str
    """Name of the group."""
    force: tuple[ForceRow, ...]
    """Force errors on unseen indenters."""
    beside: tuple[Beside, ...]
    """The paper's numbers next to ours."""
    scores: tuple[Scored, ...]
    """Scores of translated frames and of their baselines, on unseen indenters."""
    labels: StoredCompensation | None = None
    """Compensation of labels between skins; None: labels were not compensated."""
    indenters: Mapping[Variant, tuple[IndenterErrors, ...]] = field(default_factory=dict)
    """Errors by indenter, in descending order of the largest force."""

    @property
    def pairs(self) -> int:
        """Number of pairs of sensors."""
        return len({(row.source, row.target) for row in self.force if row.source != row.target})

    @property
    def after(self) -> str:
        """The last method that needs no label of the target."""
        return after({row.method for row in self.force})

    def rows(self, method: str, translator: str = NO_TRANSLATOR) -> list[ForceRow]:
        """Return the rows of one variant."""
        return [row for row in self.force if row.variant == (method, translator)]

    @property
    def best(self) -> str:
        """Translator with the most accurate forces."""
        names = {row.translator for row in self.force if row.method == self.after}
        if not names:
            raise LearningError(f"{self.name}: found no {self.after} forces; allowed: some")
        return max(
            names, key=lambda name: mean(row.errors.r2_mean for row in self.rows(self.after, name))
        )

    def label_fits(self) -> list[float]:
        """Return R2 of the training labels compared with the target's own, by pair."""
        if self.labels is None or self.after == SIMULATED:
            return []
        name = CHOICE_OF_METHOD.get(self.after)
        pairs = self.labels.pairs
        chosen = [pair.choices.get(name) if name else pair.before for pair in pairs]
        return [one.r2 for one in chosen if one is not None and one.r2 is not None]

    def dice(self, translator: str) -> dict[tuple[str, str], float]:
        """Return the Dice score of a translator's frames, by source and target."""
        return {
            (one.source, one.target): row.dice
            for one, row in self.scores
            if one.translator == translator and row.method == TRANSLATED
        }


def read_group(name: str, folder: Path) -> Group:
    """Read the folder of an experiment, complete or not.

    Raises:
        LearningError: No results, or a corrupt results file.
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


def by_indenter(
    predictions: Iterable[Predictions],
) -> Mapping[Variant, tuple[IndenterErrors, ...]]:
    """Return the errors of each variant by unseen indenter, in descending order of force.

    Args:
        predictions: Predictions of any pairs and roles; each pair and variant occurs once.
    """
    variants: dict[Variant, list[Predictions]] = {}
    for one in predictions:
        unseen = one.only(one.role == UNSEEN)
        if len(unseen):
            variants.setdefault((one.method, one.translator), []).append(unseen)
    return {variant: _of_pairs(some) for variant, some in variants.items()}


def _of_pairs(pairs: Sequence[Predictions]) -> tuple[IndenterErrors, ...]:
    names = {str(name) for one in pairs for name in one.indenter}
    found = (_of_indenter(name, pairs) for name in names)
    return tuple(sorted(found, key=lambda one: (-one.reach, natural_key(one.indenter))))


def _of_indenter(name: str, pairs: Sequence[Predictions]) -> IndenterErrors:
    reach, shear, normal, others = [], [], [], []
    for one in pairs:
        own = one.indenter == name
        if own.any():
            errors = force_errors(one.true[own], one.predicted[own], one.label_std)
            reach.append(float(np.abs(one.true[own, 2]).max()))
            shear.append(errors.shear)
            normal.append(errors.mae[2])
        if not own.all():
            others.append(float(r_squared(one.true[~own], one.predicted[~own]).mean()))
    left = float(np.mean(others)) if others else float("nan")
    return IndenterErrors(name, max(reach), float(np.mean(shear)), float(np.mean(normal)), left)


def mean(values: Iterable[float]) -> float:
    """Return the mean, or NaN if there are no values."""
    found = list(values)
    return sum(found) / len(found) if found else float("nan")
