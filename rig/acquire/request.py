"""What the operator asked for, checked before anything is started."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from recorder import Session
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
