"""What became of a trial, told by the session and the emulators, not by the rig.

Nothing here asks the collector: rows are counted in the session that is left, numbers are those
the devices gave, and the arm's place is what its emulator said.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.faults.observer import ArmState, Seen, age
from recorder import Session, SessionError, check
from rig.devices.camera.jpeg import frame_stamp

_RECENT = 3.0
# The arm's emulator ends with the bench; its last answer before that counts if no older [s].
# Findings that say what the fault did, not that something is broken.
_EXCUSED = ("gap", "clock-step", "dropped", "frozen", "truncated")


@dataclass(frozen=True, slots=True)
class Left:
    """What a session holds."""

    status: str
    rows: Mapping[str, int]
    """Readable rows by stream."""
    missing: Mapping[str, int]
    """Samples the device numbered that are not there, between those that are, by stream."""
    disorder: Mapping[str, int]
    """Rows whose number does not come after the one before, by stream."""
    findings: tuple[str, ...]
    """Codes that `recorder check` reports."""
    refused: Mapping[str, Mapping[str, int]]
    """What came and was left out, as the session states it, by stream."""


@dataclass(frozen=True, slots=True)
class Judgement:
    """One row of the page."""

    code: int | None
    """Exit code; None: it did not end."""
    what: str
    """What the rig said, in its own words."""
    noticed: float | None
    """From the fault to the word that it stops [s]."""
    left: Left | None
    """None when there is no session that can be read."""
    shown: int
    """Samples seen while recording that were compared."""
    lost: int
    """Those of them that are not in the session, and stored rows that are not there."""
    arm: str
    """Where the arm was at the end, in words."""
    wrong: tuple[str, ...] = field(default=())
    """What must not be; empty: as it should be."""


def left_in(path: Path) -> Left:
    """What is in a session.

    Raises:
        SessionError: It cannot be read.
    """
    session = Session(path)
    rows, missing, disorder = {}, {}, {}
    for name, stream in session.streams.items():
        rows[name] = len(stream)
        lost = out_of_order = 0
        for run in range(max(len(session.runs), 1)):
            steps = _steps(session, name, run)
            lost += max(int((steps - 1).sum()), 0)
            out_of_order += int((steps < 1).sum())
        missing[name], disorder[name] = lost, out_of_order
    summary = session.attrs.get("summary") or {}
    return Left(
        status=session.status,
        rows=rows,
        missing=missing,
        disorder=disorder,
        findings=tuple(sorted({finding.code for finding in check(path)})),
        refused={name: found.get("refused", {}) for name, found in summary.items()},
    )


def _steps(session: Session, name: str, run: int) -> np.ndarray:
    """By how much the device's own number grows from row to row of one run."""
    stream = session.streams[name]
    rows = session.rows_of_run(name, run)
    if name == "pose":
        rate_hz = float(stream.attrs.get("device", {}).get("rate_hz", stream.rate_hz))
        device_t = np.asarray(stream.column("device_t"))[rows]
        return np.rint(np.diff(device_t) * rate_hz).astype(np.int64)
    if name == "camera":
        first, last = rows.start or 0, len(stream) if rows.stop is None else rows.stop
        stamps = [frame_stamp(stream.jpeg(row) or b"") for row in range(first, last)]
        return np.diff([stamp[0] for stamp in stamps if stamp is not None])
    return np.diff(np.asarray(stream.column("seq"))[rows])


def losses(path: Path, seen: Seen) -> tuple[int, int]:
    """Samples compared, and how many of them the session does not have.

    Raises:
        SessionError: It cannot be read.
    """
    session = Session(path)
    compared = lost = 0
    for name in {*seen.shown, *seen.rows}:
        shown = seen.shown.get(name, set())
        times = np.asarray(session.streams[name].t_ns)
        rows = times[session.rows_of_run(name, max(len(session.runs) - 1, 0))]
        # Shown before this run's first row: not recorded yet.
        wanted = np.array(sorted(t for t in shown if len(rows) and t >= rows[0]), np.int64)
        compared += len(wanted)
        lost += int((~np.isin(wanted, times)).sum())
        lost += max(seen.rows.get(name, 0) - len(rows), 0)
    return compared, lost


def complaints(path: Path, left: Left, findings_allowed: Iterable[str] = ()) -> list[str]:
    """What no session may have: disorder, broken storage."""
    wrong = [
        f"{name}: {count} rows twice or out of order"
        for name, count in left.disorder.items()
        if count
    ]
    excused = {*_EXCUSED, *findings_allowed}
    wrong += [
        str(finding).replace(str(path), path.name)
        for finding in check(path)
        if finding.code not in excused
    ]
    return wrong


def arm_in_words(states: list[ArmState], ended_ns: int, gone: bool) -> tuple[str, bool]:
    """Where the arm was at the end, and whether that is known to be standing.

    Args:
        states: What its emulator said.
        ended_ns: When the collection had ended [ns].
        gone: Whether the controller itself was killed.
    """
    if gone:
        return "controller gone", True
    recent = [state for state in states if age(state, ended_ns) < _RECENT]
    if not recent:
        return "not known", False
    last = recent[-1]
    place = "clear" if last.clear else f"at {1e3 * last.height:.1f} mm"
    return (f"still, {place}" if last.still else f"MOVING, {place}"), last.still


def readable(path: Path) -> bool:
    """Whether there is a session at all."""
    try:
        Session(path)
    except (SessionError, OSError):
        return False
    return True
