"""Host times of a run -> UTC, for formats that know only one clock."""

from __future__ import annotations

from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.errors import SessionError
from recorder.session.align import Times
from recorder.session.reader import Session

Clock = NDArray[np.int64]


def utc_offset(session: Session, run: int) -> int:
    """Return what to add to a host time of a run to have UTC [ns since 1970].

    Raises:
        SessionError: The run has no anchor.
    """
    entry: dict[str, Any] = session.runs[run] if run < len(session.runs) else {}
    attrs = session.attrs
    t0_ns = entry.get("t0_ns", attrs.get("t0_ns"))
    utc_ns = entry.get("utc_ns")
    if utc_ns is None:
        stated = entry.get("utc", attrs.get("started_utc"))
        utc_ns = None if stated is None else parse_utc(str(stated))
    if t0_ns is None or utc_ns is None:
        raise SessionError(f"{session.name}: run {run} has no t0_ns with its utc_ns")
    return int(utc_ns) - int(t0_ns)


def parse_utc(text: str) -> int:
    """Return an ISO 8601 time as ns since 1970; a time without zone is UTC.

    Raises:
        SessionError: Not such a time.
    """
    whole, _, rest = text.strip().removesuffix("Z").partition(".")
    digits = rest[: len(rest) - len(rest.lstrip("0123456789"))]
    try:
        moment = datetime.fromisoformat(whole + rest[len(digits) :] or "")
        if moment.tzinfo is None:
            moment = datetime.fromisoformat(whole + "+00:00")
    except ValueError as error:
        raise SessionError(f"found utc {text!r}: {error}") from error
    return round(moment.timestamp()) * 10**9 + int((digits + "0" * 9)[:9])


def utc_of_rows(session: Session, name: str, times: Times) -> Clock:
    """Return times of all rows of a stream or table (n,) as UTC (n,) [ns], run by run.

    Args:
        session: The session.
        name: A stream, `segments` or `reference`.
        times: Host times (n,) [ns], one per row.

    Raises:
        SessionError: A run has no anchor.
    """
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
