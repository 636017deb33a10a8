"""Runs for exporters: the frames view divided into presses, and host times in UTC.

A press is a sequence of consecutive rows of one target in one run.
"""

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.errors import SessionError
from recorder.session.align import Times
from recorder.session.reader import Session

Rows = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class RecordedPress:
    """One press of a target."""

    target: int
    """Row of `targets`."""
    run: int
    """Entry of attrs `runs`."""
    rows: Rows
    """Rows of `frames` (n,), ascending in time."""


def need_presses(session: Session, *, valid_only: bool) -> list[RecordedPress]:
    """Return the presses that have rows, at least one, in the order in which they were made.

    Rows without an image of every camera that is a signal are left out, and with `valid_only` those
    that are not `valid`.
    """
    frames = session.frames
    if "t_ns" not in frames or not len(frames["t_ns"]):
        raise SessionError(f"{session.name}: has no frames to export")
    keep = frames["valid"] if valid_only else np.ones(len(frames["t_ns"]), np.bool_)
    for name, column in session.columns.items():
        stream = session.streams[name]
        if stream.layout.image is not None and "signal" in stream.traits.roles:
            keep = keep & (frames[column] >= 0)
    if not keep.any():
        what = "valid rows" if valid_only else "rows with an image"
        raise SessionError(f"{session.name}: its frames hold no {what}")
    rows = np.flatnonzero(keep).astype(np.int64)
    target, run = frames["target"], frames["run"]
    change = np.flatnonzero((np.diff(target[rows]) != 0) | (np.diff(run[rows]) != 0)) + 1
    return [
        RecordedPress(int(target[part[0]]), int(run[part[0]]), part)
        for part in np.split(rows, change)
    ]


# Conversion of a run's host times to UTC, for formats with a single clock.


def utc_offset(session: Session, run: int) -> int:
    """Return the offset from host times of a run to UTC [ns since 1970]."""
    entry: dict[str, Any] = session.runs[run] if run < len(session.runs) else {}
    attrs = session.attrs
    t0_ns = entry.get("t0_ns", attrs.get("t0_ns"))
    utc_ns = entry.get("utc_ns")
    if utc_ns is None:
        stated = entry.get("utc", attrs.get("started_utc"))
        utc_ns = None if stated is None else parse_utc(str(stated))
    if t0_ns is None or utc_ns is None:
        raise SessionError(
            f"{session.name}: run {run} has no start time in UTC, which this format needs "
            "(imported sessions have none); allowed: --to hdf5"
        )
    return int(utc_ns) - int(t0_ns)


def parse_utc(text: str) -> int:
    """Return an ISO 8601 time as ns since 1970; a time without a zone is UTC."""
    whole, _, rest = text.strip().removesuffix("Z").partition(".")
    digits = rest[: len(rest) - len(rest.lstrip("0123456789"))]
    try:
        moment = datetime.fromisoformat(whole + rest[len(digits) :])
        moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    except ValueError as error:
        raise SessionError(f"found utc {text!r}: {error}") from error
    return round(moment.timestamp()) * 10**9 + int((digits + "0" * 9)[:9])


def utc_of_rows(session: Session, name: str, times: Times) -> Times:
    """Return host times [ns] of all rows of a stream, `segments` or `reference` (n,) as UTC."""
    tables = {"segments": session.segments, "reference": session.reference}
    out = times.copy()
    for run in range(max(len(session.runs), 1)):
        if name in tables:
            rows = np.flatnonzero(tables[name]["run"] == run)
        else:
            rows = np.arange(len(times))[session.rows_of_run(name, run)]
        if len(rows):
            out[rows] += utc_offset(session, run)
    return out
