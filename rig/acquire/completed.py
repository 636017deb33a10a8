"""Targets that a session has completed, from which `--resume` continues."""

from collections.abc import Container, Mapping
from typing import Any

import numpy as np

from recorder.spec import OUTCOMES
from trajectories import Plan

_COMPLETE = OUTCOMES.index("complete")
_FORCE_LIMITED = OUTCOMES.index("force_limited")


def first_open_target(
    plan: Plan, segments: Mapping[str, np.ndarray], total: int, left_out: Container[int] = ()
) -> int:
    """Return the index of the first of `total` targets to press that is open, `total` if none."""
    done = finished_targets(plan, segments, total)
    open_targets = (n for n in range(total) if n not in done and n not in left_out)
    return next(open_targets, total)


def left_out_of(attrs: Mapping[str, Any]) -> dict[int, float]:
    """Return the targets that a session leaves out, and the force that they would take [N]."""
    return {
        int(index): force for index, force in attrs.get("expected_force", {}).get("left_out", ())
    }


def finished_targets(plan: Plan, segments: Mapping[str, np.ndarray], total: int) -> set[int]:
    """Return the indices of those of `total` targets that are done.

    A target is done when all its phases were completed in the same attempt, or when it ended at the
    force limit (pressing it again would end there again). A run may hold several attempts at a
    target: a new one begins with a phase already completed in the last, or after an interruption.
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
    finished = {index for index in limited if index < total}
    for target in plan.targets():
        wanted = {move.phase for move in plan.moves(target)}
        if target.index < total and any(wanted <= a for a in attempts.get(target.index, ())):
            finished.add(target.index)
    return finished
