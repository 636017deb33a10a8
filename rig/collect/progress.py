"""Which targets a session has behind it: what `--resume` continues from."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from recorder import OUTCOMES
from trajectories import Plan

_COMPLETE = OUTCOMES.index("complete")
_FORCE_LIMITED = OUTCOMES.index("force_limited")


def first_open_target(plan: Plan, segments: Mapping[str, np.ndarray], total: int) -> int:
    """Index of the first of `total` targets that is not done; `total` when all are.

    A target is done when each of its phases was completed in one and the same run, or when it
    ended at the force limit (pressing it again would end there again).

    Args:
        plan: The session's plan.
        segments: Its `segments`: target, phase, outcome, run.
        total: How many of the plan's targets the session wants.
    """
    complete: dict[tuple[int, int], set[int]] = {}
    limited: set[int] = set()
    rows = zip(
        segments["target"], segments["phase"], segments["outcome"], segments["run"], strict=True
    )
    for target, phase, outcome, run in rows:
        if outcome == _COMPLETE:
            complete.setdefault((int(target), int(run)), set()).add(int(phase))
        elif outcome == _FORCE_LIMITED:
            limited.add(int(target))
    runs = {run for _, run in complete}
    for target in plan.targets():
        if target.index >= total:
            break
        wanted = {move.phase for move in plan.moves(target)}
        done = any(wanted <= complete.get((target.index, run), set()) for run in runs)
        if not done and target.index not in limited:
            return target.index
    return total
