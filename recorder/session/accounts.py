"""Account of the samples that a session has, and of those that its streams lost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from recorder.session.align import NS
from recorder.session.loss import (
    ARRIVAL,
    DEVICE_CLOCK,
    EVENTS,
    NOTHING,
    SEQUENCE,
    Losses,
)
from recorder.session.reader import Session

Array = np.ndarray[Any, Any]

_SHOWN = 5  # targets named in a line


@dataclass(frozen=True, slots=True)
class Account:
    """Samples of one stream that a session has, and those that it lost."""

    rows: int
    """Samples stored."""
    measured_hz: float
    """Rate over the time that was recorded; pauses between runs do not count."""
    longest_gap: float
    """Longest time between two samples of a run [s]."""
    runs: tuple[Losses, ...]
    """Losses of each run."""
    by_target: Mapping[int, int]
    """Samples lost in the phases of each target, of those that lost some."""

    @property
    def lost(self) -> int:
        """Number of lost samples."""
        return sum(losses.total for losses in self.runs)

    @property
    def places(self) -> int:
        """Number of gaps."""
        return sum(len(losses.count) for losses in self.runs)

    @property
    def source(self) -> str:
        """Basis of the counts; the least exact of the runs."""
        known = (NOTHING, ARRIVAL, DEVICE_CLOCK, SEQUENCE, EVENTS)
        return min((losses.source for losses in self.runs), key=known.index, default=NOTHING)

    @property
    def sees_drops(self) -> bool:
        """True if the device itself tells of each loss, by its numbers or its clock."""
        return all(losses.counted for losses in self.runs)

    def where(self) -> str:
        """Return the targets that lost samples as text, worst first; targets count from 1."""
        if not self.lost:
            return ""
        worst = sorted(self.by_target.items(), key=lambda item: (-item[1], item[0]))
        shown = [f"target {target + 1} ({count})" for target, count in worst[:_SHOWN]]
        if len(worst) > _SHOWN:
            rest = sum(count for _, count in worst[_SHOWN:])
            shown.append(f"{len(worst) - _SHOWN} more targets ({rest})")
        outside = self.lost - sum(self.by_target.values())
        if outside:
            shown.append(f"outside of phases ({outside})")
        return ", ".join(shown)


def account_of(session: Session, name: str) -> Account:
    """Return the samples of a stream that a session has and lost, run by run."""
    stream = session.streams[name]
    runs: list[Losses] = []
    targets = Counter[int]()
    steps, seconds, longest = 0, 0.0, 0.0
    for run in range(max(len(session.runs), 1)):
        rows = session.rows_of_run(name, run)
        t_ns = stream.t_ns[rows]
        losses = session.losses(name, run)
        runs.append(losses)
        targets += by_target(losses, session.segments, run)
        if len(t_ns) > 1:
            steps += len(t_ns) - 1
            seconds += max(int(t_ns[-1]) - int(t_ns[0]), 1) * NS
            longest = max(longest, float(np.diff(t_ns).max()) * NS)
    rate = steps / seconds if seconds else 0.0
    return Account(len(stream), rate, longest, tuple(runs), dict(sorted(targets.items())))


def accounts_of(session: Session) -> dict[str, Account]:
    """Return the account of every stream, by name.

    Raises:
        SessionError: A corrupt column.
    """
    return {name: account_of(session, name) for name in session.streams}


def loss_lines(accounts: Mapping[str, Account]) -> list[str]:
    """Return a line on the losses of each stream that lost samples, or whose drops are unseen."""
    lines = []
    for name, account in accounts.items():
        if account.lost:
            lines.append(
                f"lost         {name}: {account.lost} samples in {account.places} places, counted "
                f"by {account.source}; {account.where()}"
            )
        if not account.sees_drops and account.rows:
            lines.append(f"note         {name}: {unseen(account)}")
    return lines


def unseen(account: Account) -> str:
    """Return a note for a stream whose device does not report its losses."""
    if account.source == ARRIVAL:
        return (
            "drops are inferred from arrivals and the declared rate: the device numbers no samples"
        )
    return "drops cannot be seen: the device gives neither numbers nor usable times"


def by_target(losses: Losses, segments: Mapping[str, Array], run: int) -> Counter[int]:
    """Return the samples lost in the phases of each target in one run, of those that lost some."""
    of_run = np.flatnonzero(np.asarray(segments["run"]) == run)
    lost = Counter[int]()
    if losses.total and len(of_run):
        inside = losses.inside(segments["start_ns"][of_run], segments["end_ns"][of_run])
        for target, count in zip(segments["target"][of_run].tolist(), inside.tolist(), strict=True):
            lost[target] += count
    return +lost
