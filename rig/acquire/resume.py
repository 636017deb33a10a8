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

    A target is done when each of its phases was completed in one and the same attempt, or when it
    ended at the force limit (pressing it again would end there again). A run may hold several
    attempts at a target: each begins with a phase it has behind it, or after one that broke off.

    Args:
        plan: The session's plan.
        segments: Its `segments`: target, phase, outcome, run.
        total: How many of the plan's targets the session wants.
    """
    complete: dict[tuple[int, int], set[int]] = {}
    attempts: dict[int, list[set[int]]] = {}
    limited: set[int] = set()
    rows = zip(
        segments["target"], segments["phase"], segments["outcome"], segments["run"], strict=True
    )
    for target, phase, outcome, run in rows:
        key = (int(target), int(run))
        if outcome == _COMPLETE:
            if key not in complete or phase in complete[key]:
                complete[key] = set()
                attempts.setdefault(int(target), []).append(complete[key])
            complete[key].add(int(phase))
        elif outcome == _FORCE_LIMITED:
            limited.add(int(target))
        else:
            complete.pop(key, None)
    for target in plan.targets():
        if target.index >= total:
            break
        wanted = {move.phase for move in plan.moves(target)}
        done = any(wanted <= attempt for attempt in attempts.get(target.index, ()))
        if not done and target.index not in limited:
            return target.index
    return total
