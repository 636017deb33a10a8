"""Scores of forces from sums over frames, which may be added up by indenter before."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
# Resamples of test indenters.
RESAMPLES = 2000


def sums_by_indenter(
    true: Floats, predicted: Floats, indenter: NDArray[np.str_]
) -> dict[str, list[list[float]]]:
    """Return sums (5, 3) of each indenter's frames, in JSON, from forces (n, 3) [N].

    Count, forces, their squares, squared and absolute errors.
    """
    error = predicted - true
    parts = np.stack([np.ones_like(true), true, true**2, error**2, np.abs(error)], axis=1)
    return {str(name): parts[indenter == name].sum(axis=0).tolist() for name in np.unique(indenter)}


def r2_of(sums: Floats) -> Floats:
    """Return R2 (...), mean of axes, from sums (..., 5, 3); NaN where forces do not vary.

    They do not if the sum of the squared deviations of an axis is below 1e-9. Absolute errors, the
    last of the sums, may be missing.
    """
    count, one, square, missed = np.moveaxis(sums[..., :4, :], -2, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        varied = square - one**2 / count
        fit = 1 - missed / np.where(varied > 1e-9, varied, np.nan)
    return np.asarray(fit.mean(axis=-1))


def resampled(sums: Floats, random: np.random.Generator) -> Floats:
    """Return R2 (RESAMPLES, ...) of resamples from sums by indenter (..., k, 5, 3).

    Indenters are drawn again, the same ones for all.
    """
    count = sums.shape[-3]
    counts = random.multinomial(count, np.full(count, 1 / count), RESAMPLES).astype(float)
    return r2_of(np.einsum("rk,...kqa->r...qa", counts, sums))


def interval(values: Floats, quantiles: tuple[float, float] = (0.025, 0.975)) -> Floats:
    """Return the interval between quantiles of resamples (2,); NaN if none has a value."""
    if not np.isfinite(values).any():
        return np.full(2, np.nan)
    return np.asarray(np.nanquantile(values, quantiles))
