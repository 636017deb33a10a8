"""The operator's request, checked before anything is started."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from recorder import OUTCOMES, Session, SessionError
from rig.acquire.calibration.store import Calibration
from rig.bench.bench import Bench
from rig.core.errors import ConfigError
from trajectories import Plan, Target, plan_from_json


@dataclass(frozen=True, slots=True)
class CollectRequest:
    """Request of the operator."""

    path: Path
    """The session: a new one, or with `resume` a stopped one."""
    plan: Plan
    """Targets of the session."""
    total: int
    """Number of the plan's targets in the session."""
    resume: bool = False
    """Continue with the first incomplete target."""
    again: tuple[int, ...] = ()
    """With `resume`, indices of targets to press again, done or not; readers use the last press."""
    operator: str = ""
    """Name of the operator; empty: the login name."""
    mock_sources: dict[str, Any] | None = None
    """Recordings that a mock bench's emulators play, for the session's attributes."""
    calibration: Calibration = field(default_factory=Calibration)
    """Earlier calibration that applies to this session."""
    contact_change: float = math.inf
    """Change of the signal that ends an approach on a bench without a gauge, in standard
    deviations of its noise; inf: none does."""
    after_target: Callable[[Target], None] | None = None
    """Called after each target, with the tip clear of the surface."""
    go_on: str = ""
    """Command that continues the session if it stops, or repeats it; empty: none is shown."""

    @classmethod
    def of(
        cls,
        bench: Bench,
        path: Path,
        plan: Plan | None = None,
        *,
        targets: int | None = None,
        resume: bool = False,
        again: tuple[int, ...] = (),
        **others: Any,
    ) -> CollectRequest:
        """Check a request against a bench: its plan or `plan`, or that of the resumed session.

        `targets` is the number of targets to press, None for all.
        """
        if not resume and path.exists():
            raise SessionError(f"{path}: exists already; resume it or choose another name")
        plan = bench.trajectory if plan is None else plan
        total = len(plan) if targets is None else targets
        if resume:
            plan, total = _resumed(path, bench)
        if not 1 <= total <= len(plan):
            raise ConfigError(f"--targets: found {total}; allowed: 1 to {len(plan)}")
        if unknown := [index + 1 for index in again if not 0 <= index < total]:
            raise ConfigError(f"--again: found {unknown[0]}; allowed: targets 1 to {total}")
        bench.check_limits(plan)
        return cls(path, plan, total, resume, again, **others)

    def to_press(self, first: int) -> tuple[Target, ...]:
        """Return the targets of this run in order: those to press again, and those from `first`."""
        return tuple(
            target
            for target in self.plan.targets()
            if first <= target.index < self.total or target.index in self.again
        )

    def is_complete(self) -> bool:
        """Return True if the session has nothing to resume: it was closed with all targets done."""
        session = Session(self.path)
        done = first_open_target(self.plan, session.segments, self.total) == self.total
        return done and session.status == "complete"


class StageStopped(Exception):
    """A stage was stopped; `code` is the exit code."""

    def __init__(self, code: int) -> None:
        super().__init__(f"exit code {code}")
        self.code = code


def _resumed(path: Path, bench: Bench) -> tuple[Plan, int]:
    """Return plan and number of targets of a session, which must be of the bench."""
    session = Session(path)
    attrs = session.attrs
    if attrs["sensor"] != bench.sensor:
        raise ConfigError(
            f"--sensor: found {bench.sensor!r}; {path} was recorded with {attrs['sensor']!r}"
        )
    recorded, present = set(session.streams), {row.name for row in bench.rows}
    if recorded != present:
        raise ConfigError(
            f"{path}: was recorded with the streams {', '.join(sorted(recorded))}; the bench file "
            f"has {', '.join(sorted(present))}; continue with the bench file of the recording "
            "(--bench), or record a new session"
        )
    try:
        plan = plan_from_json(attrs["plan"])
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{path}: {error}") from None
    return plan, int(attrs["targets_wanted"])


# Targets that a session has completed, from which `--resume` continues.

_COMPLETE = OUTCOMES.index("complete")
_FORCE_LIMITED = OUTCOMES.index("force_limited")


def first_open_target(plan: Plan, segments: Mapping[str, np.ndarray], total: int) -> int:
    """Return the index of the first of `total` targets that is not done; `total` if all are."""
    done = finished_targets(plan, segments, total)
    return next((index for index in range(total) if index not in done), total)


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
    found = {index for index in limited if index < total}
    for target in plan.targets():
        wanted = {move.phase for move in plan.moves(target)}
        if target.index < total and any(wanted <= a for a in attempts.get(target.index, ())):
            found.add(target.index)
    return found
