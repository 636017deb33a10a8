"""Judge a trial by its session and the emulators, not by the rig's own statements.

The collector is not consulted: rows are counted in the stored session, sequence numbers are those
of the devices, and the position of the arm is the one reported by its emulator.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.faults.observer import Observed, age
from recorder import Session, check, faults
from rig.devices.camera.jpeg import frame_stamp

# The arm's emulator ends with the bench; the collection may then take long to close its session.
# The last answer counts if the next question, or the end, came within this time of it [s].
_RECENT = 3.0
# Findings that describe the effect of the fault, not a defect.
_EXCUSED = ("gap", "clock-step", "dropped", "rate", "frozen", "truncated")


@dataclass(frozen=True, slots=True)
class Stored:
    """Content of a session."""

    status: str
    rows: Mapping[str, int]
    missing: Mapping[str, int]
    disorder: Mapping[str, int]
    """Readable rows by stream, gaps in the device's numbering, and rows that do not exceed it."""
    findings: tuple[str, ...]
    """Codes that `tactile session check` reports."""
    rejected: Mapping[str, Mapping[str, int]]
    """Number of rejected samples recorded in the session, by stream and reason."""


def stored_in(path: Path) -> Stored:
    """Return the content of a session.

    Raises:
        SessionError: It cannot be read.
    """
    session = Session(path)
    rows, missing, disorder = {}, {}, {}
    for name, stream in session.streams.items():
        steps = [_steps(session, name, run) for run in range(max(len(session.runs), 1))]
        rows[name] = len(stream)
        missing[name] = sum(max(int((of_run - 1).sum()), 0) for of_run in steps)
        disorder[name] = sum(int((of_run < 1).sum()) for of_run in steps)
    summary = session.attrs.get("summary") or {}
    return Stored(
        status=session.status,
        rows=rows,
        missing=missing,
        disorder=disorder,
        findings=tuple(sorted({finding.code for finding in faults(check(path))})),
        rejected={name: counts.get("refused", {}) for name, counts in summary.items()},
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


def losses(path: Path, observed: Observed) -> tuple[int, int]:
    """Return the number of samples compared and the number missing from the session.

    Raises:
        SessionError: It cannot be read.
    """
    session = Session(path)
    compared = lost = 0
    for name in {*observed.shown, *observed.rows}:
        shown = observed.shown.get(name, set())
        times = np.asarray(session.streams[name].t_ns)
        rows = times[session.rows_of_run(name, max(len(session.runs) - 1, 0))]
        # Samples shown before this run's first row were not yet recorded.
        wanted = np.array(sorted(t for t in shown if len(rows) and t >= rows[0]), np.int64)
        compared += len(wanted)
        lost += int((~np.isin(wanted, times)).sum())
        lost += max(observed.rows.get(name, 0) - len(rows), 0)
    return compared, lost


def complaints(path: Path, disorder: Mapping[str, int]) -> list[str]:
    """Return defects that no session may have: rows out of order, corrupt storage."""
    return [
        f"{name}: {count} rows twice or out of order" for name, count in disorder.items() if count
    ] + [
        str(finding).replace(str(path), path.name)
        for finding in faults(check(path))
        if finding.code not in _EXCUSED
    ]


def arm_in_words(observed: Observed, ended_ns: int, gone: bool) -> tuple[str, bool]:
    """Return the state of the arm at the end, and True if it is known to have stopped.

    Args:
        observed: Observations, with the states that the arm's emulator reported.
        ended_ns: Time at which the collection ended [ns].
        gone: True if the controller itself was killed.
    """
    if gone:
        return "controller gone", True
    silent_ns = observed.arm_silent_ns
    last_ns = ended_ns if silent_ns is None else min(ended_ns, silent_ns)
    if not observed.arm or age(observed.arm[-1], last_ns) >= _RECENT:
        return "not known", False
    last = observed.arm[-1]
    place = "clear" if last.clear else f"at {1e3 * last.height:.1f} mm"
    return (f"still, {place}" if last.still else f"MOVING, {place}"), last.still
