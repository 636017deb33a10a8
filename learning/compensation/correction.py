"""Equations 7 to 9: forces scaled by what two skins need for the same depth (supplement, Text 9).

    r = f_T / f_S - 1        F_SC = F_S (1 + lambda r) where d > d0, else F_S

The ratio f_T / f_S is of the loading curves while the sensor is loaded, else of the unloading ones.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from learning.compensation.prior import LOADING, Prior
from learning.errors import LearningError
from recorder import PHASES

Floats = NDArray[np.float64]

LEAST, LARGEST = 0.1, 10.0
"""f_T / f_S is kept within these: where the source hardly pushes back it says nothing."""
DEFAULT_D0, DEFAULT_WEIGHT = 0.0, 0.75
"""Taken where no label of the target is known: of the supplement's 48 choices (Tables S1 and
S2) the most frequent d0 and the median lambda."""


def compensate(
    wrench: NDArray[np.floating],
    depth: Floats,
    phase: NDArray[np.integer],
    source: Prior,
    target: Prior,
    d0: float,
    lam: float,
) -> tuple[Floats, int]:
    """Return the labels of the source as the target would give them, and how many were clamped.

    All axes are scaled alike, torques too (authors' code).

    Args:
        wrench: Labels of the source (n, 3) or (n, 6) [N, N m].
        depth: Indentation of the source (n,) [m].
        phase: Codes of phases (n,); -1 only where nothing is compensated.
        source: Prior of the sensor that the labels are of.
        target: Prior of the sensor that they are for.
        d0: Share of the source's depth range up to which nothing is changed, 0 to 1.
        lam: Weight of the correction, 0 to 1.

    Raises:
        LearningError: NaN, lengths that differ, a depth without a phase, or d0 or lam outside.
    """
    forces: Floats = np.asarray(wrench, np.float64)
    depth = np.asarray(depth, np.float64)
    _require_labels(forces, depth, phase)
    require_choice(d0, lam)
    ratio, clamped = ratios(depth, phase, source, target)
    deep = depth / source.depth_range > d0
    unknown = np.flatnonzero(deep & ((phase < 0) | (phase >= len(PHASES))))
    if unknown.size:
        raise LearningError(
            f"phase: found {phase[unknown[0]]} in row {unknown[0]}, which is pressed; allowed: "
            f"0 to {len(PHASES) - 1}"
        )
    scale = np.where(deep, 1.0 + lam * (ratio - 1.0), 1.0)
    return forces * scale[:, None], int(np.count_nonzero(clamped & deep)) if lam > 0 else 0


def ratios(
    depth: Floats, phase: NDArray[np.integer], source: Prior, target: Prior
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return f_T / f_S (n,), within `LEAST` and `LARGEST`, and which of them were clamped.

    Both curves are read at the same share of their ranges, and no deeper than both were measured:
    beyond, the ratio stays what it was. Where the source's curve is at or below 0 the ratio is the
    largest, and 1 where neither pushes back.
    """
    share = np.clip(depth / source.depth_range, 0.0, min(source.share_max, target.share_max))
    loading = np.isin(phase, LOADING)
    own, other = (
        np.where(loading, prior.loading.compression(share), prior.unloading.compression(share))
        for prior in (source, target)
    )
    pushes = own > 0
    ratio = np.where(pushes, other / np.where(pushes, own, 1.0), np.where(other > 0, np.inf, 1.0))
    kept = np.clip(ratio, LEAST, LARGEST)
    return kept, (kept != ratio) | ~pushes


def require_choice(d0: float, lam: float) -> None:
    """Refuse a starting depth or a weight outside of the paper's ranges.

    Raises:
        LearningError: Names it.
    """
    for name, value in (("d0", d0), ("lambda", lam)):
        if not 0.0 <= value <= 1.0:
            raise LearningError(f"{name}: found {value}; allowed: 0 to 1")


def _require_labels(wrench: Floats, depth: Floats, phase: NDArray[np.integer]) -> None:
    if wrench.ndim != 2 or wrench.shape[1] not in (3, 6):
        raise LearningError(f"wrench: found shape {wrench.shape}; allowed: (n, 3) or (n, 6)")
    for name, values in (("depth", depth), ("phase", phase)):
        if np.shape(values) != (len(wrench),):
            raise LearningError(
                f"{name}: found shape {np.shape(values)}; allowed: ({len(wrench)},), as the wrench"
            )
    for name, rows in (("wrench", np.isfinite(wrench).all(axis=1)), ("depth", np.isfinite(depth))):
        wrong = np.flatnonzero(~rows)
        if wrong.size:
            raise LearningError(
                f"{name}: found NaN or infinity in {wrong.size} rows, first {wrong[0]}; allowed: "
                "numbers (leave out rows without a label)"
            )
