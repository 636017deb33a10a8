"""What the operator asked for, checked before anything is started."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from recorder import OUTCOMES, Session
from rig.acquire.calibration.calibration import Calibration
from rig.bench.bench import Bench
from rig.core.errors import ConfigError
from trajectories import Plan, plan_from_json, rehearse


@dataclass(frozen=True, slots=True)
class Order:
    """What the operator asked for."""

    path: Path
    """The session, new or (with `resume`) stopped before."""
    resume: bool = False
    """Continue with the first target that is not complete."""
    targets: int | None = None
    """Press only so many targets of the plan; None for all."""
    operator: str = ""
    """Who; the login name when empty."""
    mock_facts: dict[str, Any] | None = None
    """What stands behind a mock bench's emulators, for the session's attributes."""
    calibration: Calibration = field(default_factory=Calibration)
    """What was measured of the bench before, and holds for this session."""


def plan_of(order: Order, bench: Bench, plan: Plan | None = None) -> tuple[Plan, int]:
    """The plan and how many of its targets are wanted: the bench's, or the resumed session's.

    Args:
        order: What the operator asked for.
        bench: Whose limits hold.
        plan: Taken in place of the bench's trajectory.

    Raises:
        ConfigError: Another sensor's session, too many targets, or a plan that breaks a limit.
        SessionError: The session to resume cannot be read.
    """
    plan = bench.trajectory if plan is None else plan
    total = len(plan) if order.targets is None else order.targets
    if order.resume:
        attrs = Session(order.path).attrs
        if attrs["sensor"] != bench.sensor:
            raise ConfigError(
                f"SENSOR: found {bench.sensor!r}; {order.path} was recorded with "
                f"{attrs['sensor']!r}"
            )
        plan = plan_from_json(attrs["plan"])
        total = int(attrs["targets_wanted"])
    if not 1 <= total <= len(plan):
        raise ConfigError(f"TARGETS: found {total}; allowed: 1 to {len(plan)}")
    walked = rehearse(
        plan, bench.limits.plan, speed=bench.arm.speed, acceleration=bench.arm.acceleration
    )
    if walked.broken:
        raise ConfigError(f"{bench.sensor}: the plan breaks a limit: {'; '.join(walked.broken)}")
    return plan, total


# Which targets a session has behind it: what `--resume` continues from.

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
