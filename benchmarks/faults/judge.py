"""Judge a trial by its session and the emulators, not by the rig's own statements.

The collector is not consulted: rows are counted in the stored session, sequence numbers are those
of the devices, and the position of the arm is the one reported by its emulator.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.faults.collection_run import CollectionRun
from benchmarks.faults.observer import Observed
from benchmarks.faults.rows import Row
from recorder import Session, SessionError, check, faults, recover
from rig.core.clock import SECOND_NS
from rig.devices.camera.jpeg import frame_stamp

# The arm's emulator ends with the bench; the collection may then take long to close its session.
# The last answer counts if the next question, or the end, came within this time of it [ns].
_RECENT_NS = 3 * SECOND_NS
# The arm counts as stopped below this speed [m/s].
_STILL = 1e-3
# The tip is clear of the surface above this height, half of a retract [m].
_CLEAR = 0.01
# Findings that describe the effect of the fault, not a defect.
_EXCUSED = ("gap", "clock-step", "dropped", "rate", "frozen", "truncated")
UNREPORTED = "the arm is not clear, and this is not reported"
# Maximum length of a reason; the rest is advice to the technician [characters].
_LONGEST = 150


@dataclass(frozen=True, slots=True)
class Stored:
    """Content of a session.

    By stream: readable rows, rows missing in the device's numbering, rows that do not exceed it.
    Codes that `tactile session check` reports, and rejected samples by stream and reason.
    """

    status: str
    rows: Mapping[str, int]
    missing: Mapping[str, int]
    disorder: Mapping[str, int]
    findings: tuple[str, ...]
    rejected: Mapping[str, Mapping[str, int]]


@dataclass(frozen=True, slots=True)
class RowResult:
    """Result of a collection with a fault."""

    device: str
    fault: str
    exit: int | None
    """Exit code, or None if the collection did not end."""
    reaction: str
    """Last message of the rig."""
    noticed: float | None = None
    """Time from the fault to the end of the phase that it ended [s]."""
    looked_for: int = 0
    lost: int = 0
    """Samples seen while recording, and those of them, or counted rows, that are not stored."""
    arm: str = "not known"
    wrong: tuple[str, ...] = ()
    """State of the arm at the end, and failures, in words."""
    stored: Stored | None = None
    """Content of the session, or None if it cannot be read."""


def stored_in(path: Path) -> Stored:
    """Return the content of a session."""
    session = Session(path)
    runs = range(max(len(session.runs), 1))
    steps = {name: [_steps(session, name, run) for run in runs] for name in session.streams}
    summary = session.attrs.get("summary") or {}
    return Stored(
        status=session.status,
        rows={name: len(stream) for name, stream in session.streams.items()},
        missing={
            name: sum(max(int((of_run - 1).sum()), 0) for of_run in of_stream)
            for name, of_stream in steps.items()
        },
        disorder={
            name: sum(int((of_run < 1).sum()) for of_run in of_stream)
            for name, of_stream in steps.items()
        },
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
    """Return the number of samples compared and the number missing from the session."""
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
    """Return the state of the arm at the end [ns], and True if it is known to have stopped.

    The controller itself may be `gone`: killed.
    """
    if gone:
        return "controller gone", True
    silent_ns, last = observed.arm_silent_ns, observed.arm
    until_ns = ended_ns if silent_ns is None else min(ended_ns, silent_ns)
    if last is None or until_ns - last.t_ns >= _RECENT_NS:
        return "not known", False
    place = "clear" if last.height > _CLEAR else f"at {1e3 * last.height:.1f} mm"
    stands = last.speed < _STILL
    return (f"still, {place}" if stands else f"MOVING, {place}"), stands


def judge(row: Row, collection: CollectionRun, code: int, touched: int = 0) -> RowResult:
    """Judge a trial that ended with an exit code, after a fault that `touched` some messages."""
    observed, session = collection.observed(), collection.session
    wrong = []
    if code not in row.codes:
        wrong.append(f"exit code {code}; right: {' or '.join(map(str, row.codes))}")
    arm, standing = arm_in_words(observed, collection.ended_ns, row.controller_gone)
    if not standing:
        wrong.append(f"the arm: {arm}")
    elif "clear" not in arm and "NOT RETRACTED" not in collection.text:
        wrong.append(UNREPORTED)
    noticed, looked_for, lost, stored = None, 0, 0, None
    try:
        # Check before recovery: the samples must be readable even if nobody runs it.
        looked_for, lost = losses(session, observed)
        if row.needs_recover:
            recover(session)
            lost += losses(session, observed)[1]
        stored, noticed = stored_in(session), collection.noticed()
        wrong += _defects(row, session, stored, touched)
    except (SessionError, OSError):
        wrong.append("no session can be read")
    if lost:
        wrong.append(f"{lost} accepted samples are missing")
    reaction = reaction_of(row, collection.last_line.replace(str(session), session.name))
    return RowResult(
        row.device, row.fault, code, reaction, noticed, looked_for, lost, arm, tuple(wrong), stored
    )


def _defects(row: Row, path: Path, stored: Stored, touched: int) -> list[str]:
    wrong = complaints(path, {} if row.disorder else stored.disorder)
    if row.counts is not None:
        stream, reason = row.counts
        counted = stored.rejected.get(stream, {}).get(reason, 0)
        # Several clients share the arm's line, so its fraction of the touched messages is unknown.
        if counted == 0 or (row.device != "arm" and counted != touched):
            wrong.append(f"{stream}: {counted} counted as {reason}, {touched} injected")
    return wrong


def reaction_of(row: Row, line: str) -> str:
    """Return the reason from the last printed line, without advice, addresses and times."""
    if line.startswith("complete"):
        return row.did or ("continued, counted it" if row.counts else "continued")
    if stopped := re.match(r"stopped \((.*)\): \d+ of \d+ targets", line):
        first = stopped[1].split("; ")[0]
        text = first if len(first) <= _LONGEST else f"{first[:_LONGEST]}..."
        line = text + ("; reported: not retracted" if "NOT RETRACTED" in stopped[1] else "")
    line = re.sub(r"127(\.\d+){3}", "bench", line)
    line = re.sub(r"'?/\S*/s\.zarr/?([^\s']*)'?", r"\1", line)
    line = re.sub(r"/\S*/tactile-rig-\w+/", "", line)
    return re.sub(r"t_ns = \d+", "t_ns = ...", line)
