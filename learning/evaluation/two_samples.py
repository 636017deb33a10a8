"""Can two sets of features be told apart? By a classifier, by neighbours, and by eye."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError

Floats = NDArray[np.float64]

FOLDS = 5
NEIGHBOURS = 10
"""How many neighbours of each sample the mixing score looks at."""
PERPLEXITY = 30.0
"""Of t-SNE; a third of the samples where they are fewer than a hundred."""


def classifier_accuracy(
    one: Floats, other: Floats, groups: NDArray[np.integer[Any]], *, seed: int
) -> float:
    """Return how often a linear classifier tells features (n, d) from others (m, d) rightly.

    The mean over both sets of the share of samples that a logistic regression on standardised
    features, fitted to the other folds, puts into their own set: 0.5 is chance (two-sample test
    with a classifier, Lopez-Paz and Oquab, 2017). A fold has whole groups, so that the classifier
    cannot know a sample by its likes.

    Args:
        one: Features (n, d).
        other: Features (m, d).
        groups: Number of the group of each sample (n + m,), such as its location.
        seed: Of the folds.

    Raises:
        LearningError: Fewer groups in a set than folds, or other shapes.
    """
    from sklearn.linear_model import LogisticRegression
    from sklearn.model_selection import StratifiedGroupKFold, cross_val_predict
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    _require(one, other, 2)
    features, which = _together(one, other)
    if groups.shape != which.shape:
        raise LearningError(f"groups: found shape {groups.shape}; allowed: {which.shape}")
    fewest = min(len(np.unique(groups[which == kind])) for kind in (0, 1))
    if fewest < FOLDS:
        raise LearningError(f"groups: found {fewest} in a set; allowed: {FOLDS} or more")
    classifier = make_pipeline(StandardScaler(), LogisticRegression(C=1.0, max_iter=2000))
    folds = StratifiedGroupKFold(FOLDS, shuffle=True, random_state=seed)
    said = cross_val_predict(classifier, features, which, groups=groups, cv=folds)
    return float(np.mean([(said[which == kind] == kind).mean() for kind in (0, 1)]))


def mixing_score(one: Floats, other: Floats, neighbours: int = NEIGHBOURS) -> float:
    """Return how well two sets of features (n, d), (m, d) are mixed: 1 fully, 0 not at all.

    Of each sample's k nearest neighbours by Euclid's distance, the share that is of the other set,
    over the share that is so by chance (m / (n + m - 1) for samples of the first); the mean of the
    means of both sets. Chance lets it stray from 1 to either side.

    Raises:
        LearningError: Not more samples than neighbours, or other widths.
    """
    _require(one, other, 2)
    features, which = _together(one, other)
    if len(features) <= neighbours:
        raise LearningError(
            f"features: found {len(features)} samples; allowed: more than {neighbours} neighbours"
        )
    square = np.square(features).sum(axis=1)
    apart = square[:, None] + square[None] - 2 * features @ features.T
    np.fill_diagonal(apart, np.inf)
    nearest = np.argpartition(apart, neighbours - 1, axis=1)[:, :neighbours]
    foreign = (which[nearest] != which[:, None]).mean(axis=1)
    counts = np.array([len(one), len(other)])
    expected = counts[::-1] / (counts.sum() - 1)
    return float(np.mean([foreign[which == kind].mean() / expected[kind] for kind in (0, 1)]))


def embedded(features: Floats, *, seed: int) -> Floats:
    """Return places (n, 2) of features (n, d) on a plane, by t-SNE.

    Standardised; begun from principal components, so that a seed gives one picture. A picture
    proves nothing: `mixing_score` says it in a number.

    Raises:
        LearningError: Fewer than four samples.
    """
    from sklearn.manifold import TSNE

    if len(features) < 4:
        raise LearningError(f"features: found {len(features)} samples; allowed: 4 or more")
    spread = features.std(axis=0)
    level = (features - features.mean(axis=0)) / np.where(spread > 0, spread, 1)
    perplexity = min(PERPLEXITY, len(features) / 3)
    projection = TSNE(perplexity=perplexity, init="pca", random_state=seed)
    return np.asarray(projection.fit_transform(level), np.float64)


def _together(one: Floats, other: Floats) -> tuple[Floats, NDArray[np.int64]]:
    features = np.concatenate([one, other]).astype(np.float64)
    return features, np.repeat(np.array([0, 1]), [len(one), len(other)])


def _require(one: Floats, other: Floats, least: int) -> None:
    if one.ndim != 2 or one.shape[1:] != other.shape[1:] or min(len(one), len(other)) < least:
        raise LearningError(
            f"features: found {one.shape} and {other.shape}; allowed: (n, d) and (m, d), {least} "
            "samples or more"
        )
