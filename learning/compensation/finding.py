"""The one call behind `python -m learning compensate`: priors, and choices for pairs of sensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import numpy as np

from learning.compensation.choosing import (
    D0_MM,
    D0_SHARES,
    WEIGHTS,
    Choice,
    Grid,
    Paired,
    best_for_labels,
    best_for_priors,
    tried,
)
from learning.compensation.correction import DEFAULT_D0, DEFAULT_WEIGHT
from learning.compensation.gathering import Curves, Gathered, gather_priors
from learning.compensation.labels import paired_labels
from learning.compensation.prior import Prior
from learning.compensation.store import StoredCompensation, StoredPair
from learning.errors import LearningError
from recorder import MarkerArchive

_ALIKE = 0.05
"""Depth ranges that differ by less than this share are one."""


@dataclass(frozen=True, slots=True)
class Search:
    """What is tried for each pair."""

    default: tuple[float, float] = (DEFAULT_D0, DEFAULT_WEIGHT)
    """d0 and lambda of the choice that is made without looking at anything."""
    d0: tuple[float, ...] | None = None
    """Shares of the source's depth range; None: the paper's for these sensors."""
    weights: tuple[float, ...] = WEIGHTS
    split: Path | None = None
    """File of a split; None: labels of all seen indenters."""


def find_compensation(
    archive: MarkerArchive,
    *,
    pairs: Sequence[tuple[str, str]] | None = None,
    curves: Curves | None = None,
    search: Search | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[StoredCompensation, Gathered]:
    """Return what compensates labels between an archive's sensors, and the curves behind it.

    Args:
        archive: The archive.
        pairs: Sources and targets; all pairs of sensors with a prior when None.
        curves: Where force-depth curves come from, beside the archive's own rows.
        search: What is tried for each pair.
        progress: Called with the pairs that are done and all of them.

    Raises:
        LearningError: A sensor of a pair without a prior, or fewer than two sensors with one.
        SessionError: A damaged archive or session.
    """
    search = search or Search()
    gathered = gather_priors(archive, curves or Curves())
    wanted = _wanted(archive, gathered, pairs)
    grid_d0 = search.d0
    found = []
    for done, (source, target) in enumerate(wanted):
        progress(done, len(wanted))
        one, other = gathered.priors[source], gathered.priors[target]
        paired = paired_labels(archive, source, target, search.split)
        grid = Grid(grid_d0 or _d0_of_paper(one, other), search.weights)
        found.append(_chosen(one, other, paired, grid, search.default))
    progress(len(wanted), len(wanted))
    made = StoredCompensation(dict(gathered.priors), tuple(found), made_from=archive.name)
    return made, gathered


def _chosen(
    source: Prior, target: Prior, paired: Paired | None, grid: Grid, default: tuple[float, float]
) -> StoredPair:
    choices: dict[str, Choice] = {"default": tried(paired, source, target, *default)}
    fitted = best_for_priors(source, target, grid)
    if fitted is not None:
        choices["priors"] = tried(paired, source, target, *fitted)
    if paired is not None:
        choices["oracle"] = best_for_labels(paired, source, target, grid)
    before = tried(paired, source, target, 0.0, 0.0)
    return StoredPair(
        source.sensor, target.sensor, before, choices, 0 if paired is None else len(paired)
    )


def _d0_of_paper(source: Prior, target: Prior) -> tuple[float, ...]:
    """Return starting depths as shares: in mm for skins of one kind, as shares for others.

    The supplement's Tables S1 and S2.
    """
    spans = source.depth_range, target.depth_range
    if abs(spans[0] - spans[1]) > _ALIKE * max(spans):
        return D0_SHARES
    return tuple(mm * 1e-3 / spans[0] for mm in D0_MM if mm * 1e-3 < spans[0])


def _wanted(
    archive: MarkerArchive, gathered: Gathered, pairs: Sequence[tuple[str, str]] | None
) -> list[tuple[str, str]]:
    how = (
        "; allowed: force-depth rows in the archive (location -1, phases normal_inc and "
        "normal_dec), --session or --coefficients"
    )
    if pairs is None:
        if len(gathered.priors) < 2:
            raise LearningError(
                f"{archive.name}: found force-depth curves of "
                f"{', '.join(gathered.priors) or 'no sensor'}, expected two sensors or more{how}"
            )
        return list(permutations(gathered.priors, 2))
    for name in np.unique([name for pair in pairs for name in pair]):
        if name not in archive:
            raise LearningError(f"{archive.name}: no sensor {name}; known: {', '.join(archive)}")
        if name in gathered.without:
            raise LearningError(f"{archive.name}: {name} has no force-depth curve{how}")
    return list(pairs)
