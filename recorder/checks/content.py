"""Checks of the recorded content: times, sequence numbers and values."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.findings import Finding
from recorder.session.accounts import Account, account_of, unseen
from recorder.session.align import NS
from recorder.session.columns import Stream
from recorder.session.frames import grid, has_targets, whole_run
from recorder.session.loss import (
    ARRIVAL,
    EVENTS,
    SEQUENCE,
    Losses,
    is_compressed,
    is_regular,
    other_rate,
)
from recorder.session.reader import Session
from recorder.session.uncertainty import uncalibrated
from recorder.spec import AXES, OUTCOMES, PHASES
from recorder.store.files import read_document

Array = np.ndarray[Any, Any]

# A pause that lost nothing is a gap if it exceeds both this many periods and this duration [s].
GAP_PERIODS, GAP_LEAST = 3.0, 0.05
# Equal samples are frozen if they last longer than this [s] and number at least this many.
FROZEN, FROZEN_SAMPLES = 1.0, 5
# A stream may end this long before the last phase [s].
END_MARGIN = 0.25
# A phase may begin this long before a stream does [s].
START_MARGIN = 0.1

_STEP_SAMPLES = 16  # on either side; enough that one or two late packets do not look like a step
# Column of a gauge that settles: what it read, also where that is no value.
_READING = "reading"
# Columns in which NaN means that the device sends no such value.
_NAN_IS_FINE = {"device_t", "speed"}


def check_stream(
    session: Session, stream: Stream, contents: NDArray[np.uint32] | None
) -> Iterator[Finding]:
    """Yield problems in the times, sequence numbers and values of a stream, run by run.

    `contents` has a checksum per image (n,); it is None for a stream without images.
    """
    where = f"streams/{stream.name}"
    account = account_of(session, stream.name)
    yield from _check_losses(session, where, stream.name, account)
    note = uncalibrated(stream)
    if note is not None and account.rows:
        yield Finding("uncalibrated", where, note)
    compressed = is_compressed(session.attrs)
    for run, losses in enumerate(account.runs):
        rows = session.rows_of_run(stream.name, run)
        first = rows.start or 0
        t_ns = stream.t_ns[rows]
        columns = {name: stream.array(name)[rows] for name in stream.small}
        yield from _check_times(where, first, t_ns, columns, losses, stream.rate_hz, compressed)
        still = "still" in (stream.attrs.get("source_motion"), session.attrs.get("source_motion"))
        # A scale repeats one reading while its load rests.
        if stream.traits.defaults.changes and not still and _READING not in stream.small:
            images = None if contents is None else contents[: len(stream)][rows]
            # Two NaN differ, so that axes that are not measured would hide a frozen gauge.
            same = images if images is not None else _measured(stream, "value", columns["value"])
            yield from _check_frozen(where, first, t_ns, same)
    for name in stream.small:
        values = stream.array(name)
        if values.dtype.kind == "f" and name not in _NAN_IS_FINE:
            missing = np.asarray(~np.isfinite(_measured(stream, name, values)).all(axis=1))
            if name == "value" and _READING in stream.small:
                # A reading that has not settled is kept, and is no value.
                missing &= ~np.isfinite(stream.array(_READING))[: len(missing)]
            bad = np.flatnonzero(missing)
            if bad.size:
                yield Finding("nan", f"{where}/{name}", f"{bad.size} rows, first row {bad[0]}")


def _measured(stream: Stream, name: str, values: Array) -> Array:
    """Return the numbers of each row (n, m) that the device measures."""
    axes = stream.attrs.get("axes_measured")
    if name != "value" or values.shape[1:] != (len(AXES),) or not isinstance(axes, list):
        return _flat(values)
    return values[:, [axis in axes for axis in AXES]]


def check_declared(session: Session) -> Iterator[Finding]:
    """Yield the streams, and the columns of tables, that the session declares but does not have."""
    document = read_document(session.files, session.path / "streams" / "zarr.json")
    # Streams are named when the session or a run of it began.
    names = [str(name) for name in document.get("attributes", {}).get("order", ())]
    for entry in session.runs:
        names += [name for name in entry["first_row"] if name not in ("segments", "reference")]
    for name in dict.fromkeys(names):
        if name not in session.streams:
            yield Finding("missing-array", f"streams/{name}", "the session declares this stream")
    for table in ("targets", "frames"):
        path = session.path / table / "zarr.json"
        if path not in session.files.listed(path.parent):
            continue
        columns = set(read_document(session.files, path).get("attributes", {}).get("columns", ()))
        there = {group.name for group in session.files.groups(session.path / table)}
        for name in sorted(columns - there):
            yield Finding("missing-array", f"{table}/{name}", "the table declares this column")


def check_segments(session: Session) -> Iterator[Finding]:
    """Yield phases with invalid references or no stream coverage, and streams that end early."""
    segments = session.segments
    starts, ends = segments["start_ns"], segments["end_ns"]
    limits = {
        "target": (len(next(iter(session.targets.values()), np.zeros(0)))),
        "phase": len(PHASES),
        "outcome": len(OUTCOMES),
        "run": max(len(session.runs), 1),
    }
    for name, limit in limits.items():
        bad = np.flatnonzero((segments[name] < 0) | (segments[name] >= limit))
        if bad.size:
            message = f"row {bad[0]}: found {name} {segments[name][bad[0]]}, there are {limit}"
            yield Finding("segment-outside", "segments", message)
            return
    bad = np.flatnonzero(ends <= starts)
    if bad.size:
        yield Finding("segment-outside", "segments", f"row {bad[0]} ends before it starts")
        return
    for run in np.unique(segments["run"]):
        of_run = np.flatnonzero(segments["run"] == run)
        yield from _check_cover(session, int(run), of_run, starts, ends)


def check_frames(session: Session) -> Iterator[Finding]:
    """Yield a finding if the frames view does not have one row per tick of the segments."""
    segments = session.segments
    if "t_ns" not in session.frames:
        yield Finding("frames-length", "frames", "missing")
        return
    expected = 0
    if not has_targets(session):
        for run in range(max(len(session.runs), 1)):
            expected += len(whole_run(session, run, session.rate_hz))
    for run in np.unique(segments["run"]):
        of_run = np.flatnonzero(segments["run"] == run)
        anchor = int(segments["start_ns"][of_run].min())
        for row in of_run:
            start, end = int(segments["start_ns"][row]), int(segments["end_ns"][row])
            expected += len(grid(anchor, start, end, session.rate_hz))
    found = len(session.frames["t_ns"])
    if found != expected:
        yield Finding("frames-length", "frames", f"found {found} rows, expected {expected}")


def _check_losses(session: Session, where: str, name: str, account: Account) -> Iterator[Finding]:
    if account.lost:
        place = next(
            (session.rows_of_run(name, run).start or 0) + int(losses.row[0])
            for run, losses in enumerate(account.runs)
            if losses.total
        )
        by = {ARRIVAL: f"arrival at {session.streams[name].rate_hz:g} Hz"}
        message = (
            f"{account.lost} samples lost in {account.places} places, counted by "
            f"{by.get(account.source, account.source)}; first before row {place}"
        )
        yield Finding("dropped", where, f"{message}; {account.where()}")
    if not account.sees_drops and account.rows:
        yield Finding("drops-unseen", where, unseen(account))


def _check_times(
    where: str,
    first: int,
    t_ns: NDArray[np.int64],
    columns: Mapping[str, Array],
    losses: Losses,
    rate_hz: float,
    compressed: bool,
) -> Iterator[Finding]:
    if len(t_ns) < 2:
        return
    limit = max(GAP_PERIODS / rate_hz, GAP_LEAST)
    steps = np.diff(t_ns) * NS
    jumped = np.zeros(0, np.intp) if compressed else _clock_steps(t_ns, columns, limit)
    if jumped.size:
        at = jumped[0]
        message = f"{jumped.size} found, first at row {first + at + 1}, {steps[at]:+.3f} s"
        yield Finding("clock-step", where, message)
    explained = np.zeros(len(steps), np.bool_)
    explained[losses.row - 1] = True
    explained[jumped] = True
    if losses.source == SEQUENCE:
        repeated = np.flatnonzero(np.diff(columns["seq"]) <= 0)
        if repeated.size:
            message = f"{repeated.size} found, first at row {first + repeated[0] + 1}"
            yield Finding("seq-order", f"{where}/seq", message)
    backward = np.flatnonzero((steps <= 0) & ~explained)
    if backward.size:
        at = backward[0]
        message = f"{backward.size} found, first at row {first + at + 1}, {steps[at]:+.6f} s"
        yield Finding("time-order", where, message)
    if compressed or losses.source == EVENTS:
        return
    gaps = np.flatnonzero((steps > limit) & ~explained)
    if gaps.size:
        worst_at = gaps[np.argmax(steps[gaps])]
        message = (
            f"{gaps.size} found, longest {steps[worst_at]:.3f} s before row {first + worst_at + 1}"
        )
        yield Finding("gap", where, f"{message}, limit {limit:.3f} s")
    found = other_rate(t_ns, rate_hz, losses)
    if found is not None:
        row, seconds, measured = found
        message = f"{measured:.4g} Hz for {seconds:.1f} s from row {first + row}"
        yield Finding("rate", where, f"{message}, declared {rate_hz:g} Hz")


def _clock_steps(
    t_ns: NDArray[np.int64], columns: Mapping[str, Array], limit: float
) -> NDArray[np.intp]:
    """Return the rows after which the offset between host and device has changed permanently."""
    device_t = columns.get("device_t")
    # Without a device clock, a step cannot be distinguished from a device that paused: a gap.
    if device_t is None or not np.isfinite(device_t).all():
        return np.zeros(0, np.intp)
    offset = (t_ns - t_ns[0]) * NS - (device_t - device_t[0])
    found = [
        at
        for at in map(int, np.flatnonzero(np.abs(np.diff(offset)) > limit))
        if abs(_level(offset, at + 1, 1) - _level(offset, at, -1)) > limit / 2
    ]
    return np.array(found, np.intp)


def _level(offset: NDArray[np.float64], at: int, direction: int) -> float:
    """Return the median of the samples from row `at` on, forward or backward."""
    if direction > 0:
        return float(np.median(offset[at : at + _STEP_SAMPLES]))
    return float(np.median(offset[max(at - _STEP_SAMPLES + 1, 0) : at + 1]))


def _check_frozen(
    where: str, first: int, t_ns: NDArray[np.int64], values: Array
) -> Iterator[Finding]:
    if len(values) < FROZEN_SAMPLES:
        return
    flat = _flat(values)
    changed = np.flatnonzero((flat[1:] != flat[:-1]).any(axis=1)) + 1
    starts = np.concatenate([[0], changed])
    ends = np.concatenate([changed, [len(values)]]) - 1
    lasting = (t_ns[ends] - t_ns[starts]) * NS
    frozen = np.flatnonzero((lasting > FROZEN) & (ends - starts + 1 >= FROZEN_SAMPLES))
    if frozen.size:
        worst = frozen[np.argmax(lasting[frozen])]
        message = f"{frozen.size} times, longest {lasting[worst]:.1f} s from row"
        yield Finding("frozen", where, f"{message} {first + starts[worst]}, limit {FROZEN} s")


def _check_cover(
    session: Session,
    run: int,
    of_run: NDArray[np.intp],
    starts: NDArray[np.int64],
    ends: NDArray[np.int64],
) -> Iterator[Finding]:
    late: dict[int, str] = {}
    for stream in session.streams.values():
        if not is_regular(stream):
            continue
        where = f"streams/{stream.name}"
        t_ns = stream.t_ns[session.rows_of_run(stream.name, run)]
        if not len(t_ns):
            yield Finding("truncated", where, f"run {run}: no samples at all")
            continue
        late[int(t_ns[0])] = where
        short = (int(ends[of_run].max()) - int(t_ns[-1])) * NS
        if short > END_MARGIN:
            message = f"run {run}: ends {short:.1f} s before the last phase"
            yield Finding("truncated", where, message)
    if not late:
        return
    lead = (max(late) - starts[of_run]) * NS
    early = np.flatnonzero(lead > START_MARGIN)
    if early.size:
        message = f"row {of_run[early[0]]} starts {lead[early[0]]:.3f} s before {late[max(late)]}"
        yield Finding("segment-outside", "segments", f"{message} does, in run {run}")


def _flat(values: Array) -> Array:
    return values.reshape(len(values), int(np.prod(values.shape[1:])))
