"""Distances between two sets of features: Frechet's, and that of a kernel.

They carry the names FID and KID only with the features of Inception; otherwise they are named by
whatever made the features.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError

Floats = NDArray[np.float64]

DEGREE = 3
"""Degree of the kernel (x y / d + 1)^degree of the kernel distance (Binkowski et al., 2018)."""


def frechet_distance(one: Floats, other: Floats) -> float:
    """Return the Frechet distance of two sets of features (n, d), (m, d), taken for Gaussian.

    |mean1 - mean2|^2 + tr(C1 + C2 - 2 (C1 C2)^(1/2)), covariances with n - 1 (Heusel et al., 2017).
    It comes out too large by what few samples miss of many dimensions: compare it with that of two
    sets of the same kind and number.

    Raises:
        LearningError: Fewer than two samples, other widths, or features that are not numbers.
    """
    _require_samples(one, other, least=2)
    apart = one.mean(axis=0) - other.mean(axis=0)
    first, second = (np.atleast_2d(np.cov(samples, rowvar=False)) for samples in (one, other))
    # tr (C1 C2)^(1/2) = tr (S C2 S)^(1/2) with S = C1^(1/2), which is symmetric.
    root = _root(first)
    values = np.linalg.eigvalsh(root @ second @ root)
    cross = np.sqrt(np.clip(values, 0, None)).sum()
    # Zero but for rounding may come out below it.
    return max(float(apart @ apart + np.trace(first) + np.trace(second) - 2 * cross), 0.0)


def kernel_distance(
    one: Floats, other: Floats, *, size: int, subsets: int, seed: int
) -> tuple[float, float]:
    """Return mean and standard deviation of the squared kernel distance over random subsets.

    Each is the unbiased estimate with kernel (x y / d + 1)^3 (Binkowski et al., 2018): near zero,
    and as often below it, for sets of one kind.

    Args:
        one: Features (n, d).
        other: Features (m, d).
        size: Samples of either in a subset; at most half of those that there are.
        subsets: How many subsets.
        seed: Of what is drawn.

    Raises:
        LearningError: Fewer than two samples, other widths, or features that are not numbers.
    """
    _require_samples(one, other, least=2)
    size = max(min(size, len(one) // 2, len(other) // 2), 2)
    chance = np.random.default_rng(seed)
    found = [
        squared_kernel_distance(
            one[chance.choice(len(one), size, replace=False)],
            other[chance.choice(len(other), size, replace=False)],
        )
        for _ in range(subsets)
    ]
    return float(np.mean(found)), float(np.std(found))


def squared_kernel_distance(one: Floats, other: Floats) -> float:
    """Return the unbiased squared maximum mean discrepancy of features (n, d), (m, d).

    Raises:
        LearningError: Fewer than two samples, other widths, or features that are not numbers.
    """
    _require_samples(one, other, least=2)

    def within(samples: Floats) -> float:
        kernel = _kernel(samples, samples)
        count = len(samples)
        return float((kernel.sum() - np.trace(kernel)) / (count * (count - 1)))

    return within(one) + within(other) - 2 * float(_kernel(one, other).mean())


def _kernel(one: Floats, other: Floats) -> Floats:
    return np.asarray((one @ other.T / one.shape[1] + 1) ** DEGREE, np.float64)


def _root(matrix: Floats) -> Floats:
    """Return the symmetric square root of a symmetric matrix (d, d) that has no negative values."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.sqrt(np.clip(values, 0, None))) @ vectors.T, np.float64)


def _require_samples(one: Floats, other: Floats, least: int) -> None:
    for samples in (one, other):
        if samples.ndim != 2 or len(samples) < least or samples.shape[1] != one.shape[1]:
            raise LearningError(
                f"features: found {one.shape} and {other.shape}; allowed: (n, d) and (m, d), "
                f"{least} samples or more"
            )
        if not np.isfinite(samples).all():
            raise LearningError("features: found some that are not numbers; allowed: numbers")
