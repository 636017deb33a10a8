"""Page `docs/results/effects.md`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import warp as wp

from benchmarks.sim.effects.declaration import EFFECTS
from benchmarks.sim.effects.measure import PARTS, Combination, Cost
from benchmarks.sim.effects.scenes import TRIALS
from recorder import pages


def render(costs: Sequence[Cost], combinations: Sequence[Combination], repeats: int) -> str:
    """Return the page as Markdown."""
    return pages.render(
        Path(__file__).with_suffix(".md"),
        costs=costs,
        combinations=combinations,
        repeats=repeats,
        effects=EFFECTS,
        trials=TRIALS,
        parts=PARTS,
        elements=12 * 12 * 4,
        yes=("**no**", "yes"),
        warp=wp.config.version,
    )
