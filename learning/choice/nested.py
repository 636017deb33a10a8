"""Choice among ways by leaving indenters out, nested: whoever reports an indenter never saw it.

Indenters are divided into folds. A model without folds i and j predicts both: its errors on j help
to choose the way that is scored on i, and the other way round. So the score of the choice is on
indenters that had no part in any choice, training or calibration. The delivered way is chosen by
the errors on all folds.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from learning.choice.candidates import Candidate, Frames, of_indenters
from learning.data.presses import Presses
from learning.errors import LearningError
from learning.force.intervals import AxisError, errors_at, fit_errors
from learning.force.model import AXES, ForceModel
from learning.metrics import axis_means, can_be_scored, force_errors, spread_and_range
from learning.training.run import generator
from recorder.progress import ReportItems

Floats = NDArray[np.float64]
Fold = frozenset[int]
# Most folds, and fewest indenters among which there is a choice.
FOLDS, FEWEST = 4, 3
# Way without a choice: its features and its penalty are fixed.
USUAL = "ridge"


@dataclass(frozen=True, slots=True, eq=False)
class Labelled:
    """Labels of the frames of a sensor, and their indenters."""

    forces: Floats
    """Fx, Fy, Fz (n, 3) [N]; NaN without a label."""
    indenter: NDArray[np.int64]
    """Code of the indenter of each frame (n,)."""

    @property
    def codes(self) -> list[int]:
        """Codes of the indenters, in order."""
        return [int(code) for code in np.unique(self.indenter)]

    def require(self, folds: Sequence[Fold]) -> None:
        """Reject an axis that is constant, or has labels in too few folds to be left out."""
        for name, forces in zip(AXES, self.forces.T, strict=True):
            known = np.isfinite(forces)
            inside = [np.isin(self.indenter[known], sorted(fold)).any() for fold in folds]
            if known.any() and (
                np.ptp(forces[known]) == 0 or sum(inside) < min(FEWEST, len(folds))
            ):
                raise LearningError(
                    f"labels: found {name} from {forces[known].min():g} to "
                    f"{forces[known].max():g} N, under {len(np.unique(self.indenter[known]))} "
                    f"indenters; allowed: forces that differ, of each axis under {FEWEST} "
                    "indenters or more, or none of an axis"
                )

    def errors(self, predicted: Floats) -> Floats:
        """Return the mean square error by indenter (k,), over the variance of all labels.

        Of predictions (n, 3); it is the mean of the axes, NaN for an indenter without any.
        """
        mean = axis_means(self.forces)
        variance = axis_means(np.square(self.forces - mean))
        off = np.square(predicted - self.forces) / np.where(variance > 0, variance, np.nan)
        by_axis = np.array([axis_means(off[self.indenter == code]) for code in self.codes])
        return axis_means(by_axis.T)

    def fits(self, predicted: Floats) -> Floats:
        """Return R2 by indenter and axis (k, 3) of predictions (n, 3); NaN without labels."""
        spread, _ = spread_and_range(self.forces)
        fits = np.full((len(self.codes), 3), np.nan)
        for row, code in enumerate(self.codes):
            true, guess = (each[self.indenter == code] for each in (self.forces, predicted))
            if can_be_scored(true, guess):
                fits[row] = force_errors(true, guess, spread).r2
        return fits


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """A way that was chosen, and how good the choice is."""

    name: str
    errors: Mapping[str, Floats]
    """Errors of each way by indenter (k,), each left out."""
    left_out: Floats
    """Predictions of the way on indenters that it was trained without (n, 3) [N]."""
    nested: Floats
    """Predictions of the ways that were chosen without the indenter (n, 3) [N]; or of this way, if
    there was no choice."""
    by_fold: tuple[tuple[Fold, str], ...]
    """Indenters of each fold, and the way that was chosen without them."""
    covered: Floats
    """1 where a label is within the interval that was calibrated without the indenter, else 0;
    NaN without either (n, 3)."""


def folds_of(codes: Sequence[int], seed: int, most: int = FOLDS) -> list[Fold]:
    """Divide indenters into folds, by the seed alone."""
    order = generator(seed, "choice", "folds").permutation(sorted(codes))
    return [frozenset(part.tolist()) for part in np.array_split(order, min(most, len(order)))]


def simplest(ways: Sequence[str], errors: Mapping[str, Floats]) -> str:
    """Return the first way that the best one does not beat clearly; ways begin with the simplest.

    It is beaten if its mean error is larger by more than a standard error of their difference, over
    indenters.
    """
    means = {way: float(axis_means(errors[way][:, None])[0]) for way in ways}
    best = min(ways, key=means.__getitem__)
    for way in ways:
        apart = errors[way] - errors[best]
        apart = apart[np.isfinite(apart)]
        spread = float(apart.std(ddof=1)) / np.sqrt(len(apart)) if len(apart) > 1 else 0.0
        if means[way] - means[best] <= spread:
            return way
    return best


def choose(
    candidates: Sequence[Candidate],
    frames: Frames,
    labels: Labelled,
    *,
    seed: int,
    kept: Path,
    progress: ReportItems = lambda done, total: None,
) -> Choice:
    """Train every way without some folds, and choose; what is in the folder `kept` is not repeated.

    Raises:
        LearningError: Labels are on fewer than two indenters.
    """
    codes = labels.codes
    if len(codes) < 2:
        raise LearningError(
            f"labels: found on {len(codes)} indenters; allowed: two or more, as one is left out "
            "(`tactile train force` trains on one)"
        )
    folds = folds_of(codes, seed)
    labels.require(folds)
    if len(codes) < FEWEST:
        candidates = [each for each in candidates if each.name == USUAL] or candidates[:1]
    ways = [each.name for each in candidates]
    left = {frozenset((i,)) for i in range(len(folds))}
    if len(codes) >= FEWEST:
        left |= {frozenset(pair) for pair in combinations(range(len(folds)), 2)}
    predicted = dict(
        _predictions(candidates, frames, folds, sorted(left, key=sorted), seed, kept, progress)
    )
    held = [np.isin(labels.indenter, sorted(fold)) for fold in folds]
    whole = {way: _joined(predicted, way, held) for way in ways}
    errors = {way: labels.errors(whole[way]) for way in ways}
    name = simplest(ways, errors)
    nested, covered = np.full_like(labels.forces, np.nan), np.full_like(labels.forces, np.nan)
    by_fold = []
    for index, (fold, inside) in enumerate(zip(folds, held, strict=True)):
        chosen, inner = name, whole[name]
        if len(codes) >= FEWEST:
            others = {way: _joined(predicted, way, held, index) for way in ways}
            # Not even the variance that errors are divided by is of the fold.
            seen = replace(labels, forces=np.where(inside[:, None], np.nan, labels.forces))
            chosen = simplest(ways, {way: seen.errors(others[way]) for way in ways})
            inner = others[chosen]
        nested[inside] = predicted[chosen, frozenset((index,))][inside]
        indenters = labels.indenter[~inside].astype(str)
        axes = fit_errors(inner[~inside], labels.forces[~inside], indenters)
        covered[inside] = contained(axes, nested[inside], labels.forces[inside])
        by_fold.append((fold, chosen))
    return Choice(name, errors, whole[name], nested, tuple(by_fold), covered)


def _predictions(
    candidates: Sequence[Candidate],
    frames: Frames,
    folds: Sequence[Fold],
    left: Sequence[frozenset[int]],
    seed: int,
    kept: Path,
    progress: ReportItems,
) -> Iterator[tuple[tuple[str, frozenset[int]], Floats]]:
    """Yield the predictions (n, 3) of each way without some folds, on these folds, else NaN."""
    kept.mkdir(parents=True, exist_ok=True)
    total, done = len(candidates) * len(left), 0
    for some in left:
        indenters: Fold = frozenset().union(*(folds[index] for index in some))
        for way in candidates:
            progress(done, total)
            file = kept / f"{way.name}.{'-'.join(map(str, sorted(some)))}.npy"
            if not file.exists():
                presses = frames[way.form]
                model = way.train(presses, seed, indenters)
                forces = _of_folds(model, presses, indenters)
                part = file.with_suffix(".part.npy")
                np.save(part, forces)
                part.replace(file)
            yield (way.name, some), np.load(file)
            done += 1
    progress(total, total)


def _of_folds(model: ForceModel, presses: Presses, indenters: Fold) -> Floats:
    """Return the forces (n, 3) [N] of the presses of some indenters; NaN for others."""
    forces, inside = np.full((presses.frames, 3), np.nan), of_indenters(presses, indenters)
    forces[inside[presses.of_frame].numpy()] = model.predict(presses.only(inside))
    return forces


def _joined(
    predicted: Mapping[tuple[str, frozenset[int]], Floats],
    way: str,
    held: Sequence[NDArray[np.bool_]],
    besides: int | None = None,
) -> Floats:
    """Return the predictions (n, 3) of each fold by a model without it, and without `besides`."""
    joined = np.full((len(held[0]), 3), np.nan)
    for fold, inside in enumerate(held):
        if fold != besides:
            some = frozenset((fold,) if besides is None else (fold, besides))
            joined[inside] = predicted[way, some][inside]
    return joined


def contained(axes: Sequence[AxisError | None], predicted: Floats, true: Floats) -> Floats:
    """Return 1 where a label (n, 3) is within its interval, 0 where not, NaN without either."""
    off, error = np.abs(predicted - true), errors_at(axes, predicted)
    known = np.isfinite(off) & np.isfinite(error)
    return np.where(known, (off <= error).astype(np.float64), np.nan)
