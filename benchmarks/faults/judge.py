"""Judge a trial by its session and the emulators, not by the rig's own statements.

The collector is not consulted: rows are counted in the stored session, sequence numbers are those
of the devices, and the position of the arm is the one reported by its emulator.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.faults.observer import Seen, age
from recorder import Session, SessionError, check, faults
from rig.devices.camera.jpeg import frame_stamp

# The arm's emulator ends with the bench; the collection may then take long to close its session.
# The last answer counts if the next question, or the end, came within this time of it [s].
_RECENT = 3.0
# Findings that describe the effect of the fault, not a defect.
_EXCUSED = ("gap", "clock-step", "dropped", "rate", "frozen", "truncated")


@dataclass(frozen=True, slots=True)
class Left:
    """Content of a session."""

    status: str
    rows: Mapping[str, int]
    """Number of readable rows by stream."""
    missing: Mapping[str, int]
    """Number of gaps in the device's numbering, by stream."""
    disorder: Mapping[str, int]
    """Number of rows whose number does not exceed the one before, by stream."""
    findings: tuple[str, ...]
    """Codes that `tactile session check` reports."""
    rejected: Mapping[str, Mapping[str, int]]
    """Number of rejected samples recorded in the session, by stream and reason."""


@dataclass(frozen=True, slots=True)
class FaultResult:
    """One row of the page."""

    code: int | None
    """Exit code, or None if the collection did not end."""
    what: str
    """Last message of the rig."""
    noticed: float | None
    """Time from the fault to the message that the rig stops [s]."""
    left: Left | None
    """Content of the session, or None if it cannot be read."""
    shown: int
    """Number of samples seen while recording, which were looked for in the session."""
    lost: int
    """Number of those that are missing from the session, plus missing stored rows."""
    arm: str
    """State of the arm at the end, in words."""
    wrong: tuple[str, ...] = field(default=())
    """Failures; empty if the row passed."""


def left_in(path: Path) -> Left:
    """Return the content of a session.

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
        findings=tuple(sorted({finding.code for finding in faults(check(path))})),
        rejected={name: found.get("refused", {}) for name, found in summary.items()},
    )


def _steps(session: Session, name: str, run: int) -> np.ndarray:
    """Return the increments of the device's own number from row to row of one run."""
    stream = session.streams[name]
    rows = session.rows_of_run(name, run)
    if name == "pose":
        rate_hz = float(stream.attrs.get("device", {}).get("rate_hz", stream.rate_hz))
        device_t = np.asarray(stream.array("device_t"))[rows]
        return np.rint(np.diff(device_t) * rate_hz).astype(np.int64)
    if name == "camera":
        first, last = rows.start or 0, len(stream) if rows.stop is None else rows.stop
        stamps = [frame_stamp(stream.jpeg(row) or b"") for row in range(first, last)]
        return np.diff([stamp[0] for stamp in stamps if stamp is not None])
    return np.diff(np.asarray(stream.array("seq"))[rows])


def losses(path: Path, seen: Seen) -> tuple[int, int]:
    """Return the number of samples compared and the number missing from the session.

    Raises:
        SessionError: It cannot be read.
    """
    session = Session(path)
    compared = lost = 0
    for name in {*seen.shown, *seen.rows}:
        shown = seen.shown.get(name, set())
        times = np.asarray(session.streams[name].t_ns)
        rows = times[session.rows_of_run(name, max(len(session.runs) - 1, 0))]
        # Samples shown before this run's first row were not yet recorded.
        wanted = np.array(sorted(t for t in shown if len(rows) and t >= rows[0]), np.int64)
        compared += len(wanted)
        lost += int((~np.isin(wanted, times)).sum())
        lost += max(seen.rows.get(name, 0) - len(rows), 0)
    return compared, lost


def complaints(path: Path, left: Left, findings_allowed: Iterable[str] = ()) -> list[str]:
    """Return defects that no session may have: disorder, corrupt storage."""
    wrong = [
        f"{name}: {count} rows twice or out of order"
        for name, count in left.disorder.items()
        if count
    ]
    excused = {*_EXCUSED, *findings_allowed}
    wrong += [
        str(finding).replace(str(path), path.name)
        for finding in faults(check(path))
        if finding.code not in excused
    ]
    return wrong


def arm_in_words(seen: Seen, ended_ns: int, gone: bool) -> tuple[str, bool]:
    """Return the state of the arm at the end, and True if it is known to have stopped.

    Args:
        seen: Observations, with the states that the arm's emulator reported.
        ended_ns: Time at which the collection ended [ns].
        gone: True if the controller itself was killed.
    """
    if gone:
        return "controller gone", True
    last_ns = ended_ns if seen.arm_silent_ns is None else min(ended_ns, seen.arm_silent_ns)
    if not seen.arm or age(seen.arm[-1], last_ns) >= _RECENT:
        return "not known", False
    last = seen.arm[-1]
    place = "clear" if last.clear else f"at {1e3 * last.height:.1f} mm"
    return (f"still, {place}" if last.still else f"MOVING, {place}"), last.still


def readable(path: Path) -> bool:
    """Return True if the session can be opened."""
    try:
        Session(path)
    except (SessionError, OSError):
        return False
    return True
