"""Check a session or a marker archive for every known problem, read-only."""

import math
import os
from collections import defaultdict
from collections.abc import Iterator
from itertools import islice, product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.checks.plausible import doubts
from recorder.errors import SessionError
from recorder.findings import Finding
from recorder.session.align import NS, changed, flat, measured
from recorder.session.columns import Rows, Stream, blocks
from recorder.session.loss import (
    ARRIVAL,
    EVENTS,
    SEQUENCE,
    Account,
    Losses,
    is_compressed,
    is_regular,
    numbers,
    other_rate,
    unseen,
    witnesses,
)
from recorder.session.reader import Session
from recorder.session.states import READING, in_stalls, stalls, states
from recorder.session.uncertainty import uncalibrated
from recorder.spec import (
    ARCHIVE_FORMAT,
    OUTCOMES,
    PHASES,
    SEGMENTS,
    StreamSpec,
    Traits,
    camera_spec,
    depth_spec,
    force_spec,
    pose_spec,
    reference_spec,
    taxels_spec,
)
from recorder.store.documents import read_document, read_session_attrs, says_it_is
from recorder.store.files import Files, locate
from recorder.store.layout import MISSING, PARTIAL, Array, ColumnLayout, StreamLayout, check_shape
from recorder.store.manifest import GROUP, wrong_files
from recorder.store.reader import Table
from recorder.store.records import CRC_BYTES, HEADER, record_matches


def check(path: str | os.PathLike[str], *, quick: bool = False) -> list[Finding]:
    """Return the faults, warnings and notes of a session, or of a marker archive.

    Each finding states its `level`: `fault`; `warning`, of values that can hardly be true; `note`,
    of what cannot be told. Unreadable data is reported once and its content is not checked. `quick`
    holds only metadata and the ends of shards against the manifest: it takes seconds and finds
    files that were removed, added or exchanged, but not each flipped bit.

    Raises:
        SessionError: Neither a session nor an archive, or `quick` for an archive.
    """
    files, root = locate(path)
    if says_it_is(root, files, ARCHIVE_FORMAT):
        if quick:
            raise SessionError(f"{path}: a marker archive has no manifest; check it without quick")
        from recorder.archive.check import check_archive  # of no use to a session

        return list(check_archive(files, root))
    return list(_check(path, files, root, quick))


def _check(
    place: str | os.PathLike[str], files: Files, path: Path, quick: bool
) -> Iterator[Finding]:
    attrs = read_session_attrs(path, files)
    if attrs.get("status") == "recording":
        message = "status is 'recording': still running, or killed (tactile session recover)"
        yield Finding("unfinished", ".", message)
    broken = False
    for finding in _check_manifest(files, path, attrs):
        yield finding
        # Without its manifest, a session can still be read.
        broken |= finding.code == "manifest" and finding.where != GROUP
    if quick:
        return
    unreadable: set[str] = set()
    for finding in _check_arrays(files, path):
        yield finding
        if finding.code == "metadata":
            unreadable.add(finding.where)
    if unreadable:
        return
    contents = {}
    groups = files.groups(path / "streams")
    for group in (*groups, path / "segments", path / "reference"):
        findings = list(_check_stream_files(files, path, group))
        if not any(finding.code in ("metadata", "wrong-dtype") for finding in findings):
            for layout in StreamLayout.load(group, files).columns:
                damage, crcs = _check_chunks(path, layout)
                findings += damage
                if layout.is_image:
                    contents[group.name] = crcs
        yield from findings
        if any(finding.code not in ("torn-tail", "journal-left") for finding in findings):
            unreadable.add(group.name)
    damaged_tables = set()
    for name in ("targets", "frames"):
        for finding in _check_table(files, path, name):
            yield finding
            damaged_tables.add(name)
    if broken:
        return
    try:
        session = Session(place, unsealed=True)
        yield from _check_declared(session)
        if not unreadable:
            yield from states(session)
        for name, stream in session.streams.items():
            if name not in unreadable:
                yield from check_stream(session, stream, contents.get(name))
        if not unreadable and "targets" not in damaged_tables:
            yield from _check_segments(session)
        if "segments" not in unreadable and "frames" not in damaged_tables:
            yield from _check_frames(session)
        if not unreadable and "targets" not in damaged_tables:
            yield from doubts(session, notes=True)
    except SessionError as error:
        yield Finding("metadata", ".", str(error))


# Files on disk: completeness and checksums.


def _check_manifest(files: Files, session: Path, attrs: dict[str, Any]) -> Iterator[Finding]:
    """Yield files that differ from the session's manifests, without reading data."""
    for entry in attrs.get("sealed_later", ()):
        runs = ", ".join(map(str, entry["lost"]))
        message = f"the manifest of run {runs} was lost and made again on {entry['utc']}"
        yield Finding("sealed-later", ".", f"{message}; changes before then cannot be seen")
    for key, message in wrong_files(files, session, attrs):
        yield Finding("manifest", key, message)


def _check_arrays(files: Files, session: Path) -> Iterator[Finding]:
    """Yield arrays without units in the whole session."""
    documents = (path for path in files.listed(session) if path.name == "zarr.json")
    for path in sorted(documents):
        node_path = str(path.parent.relative_to(session))
        try:
            document = read_document(files, path)
        except SessionError as error:
            yield Finding("metadata", node_path, str(error))
            continue
        units = document.get("attributes", {}).get("units")
        if document.get("node_type") == "array" and not units:
            yield Finding("missing-units", node_path, f"found units {units!r}")


def _check_table(files: Files, session: Path, name: str) -> Iterator[Finding]:
    """Yield missing and corrupt chunks, and unequal lengths, in a group written in one go."""
    lengths = {}
    there = set(files.listed(session / name))
    for group in files.groups(session / name):
        column_path = f"{name}/{group.name}"
        document = read_document(files, group / "zarr.json")
        try:
            shape, chunk = document["shape"], document["chunk_grid"]["configuration"]["chunk_shape"]
            check_shape(shape, document["data_type"], str(group))
            counts = [range(math.ceil(s / c)) for s, c in zip(shape, chunk, strict=True)]
        except (KeyError, TypeError, ValueError, ZeroDivisionError, SessionError) as error:
            yield Finding("metadata", column_path, f"not a column of a table: {error!r}")
            continue
        lengths[group.name] = shape[0]
        # One more than the files that exist: at least one of them is missing then.
        most = len(there) + 1
        indices = islice(product(*(count[:most] for count in counts)), most)
        some = [group.joinpath("c", *map(str, index)) for index in indices]
        missing = [key for key in some if key not in there]
        if missing:
            more = math.prod(map(len, counts)) - len(some) + len(missing)
            yield Finding("missing-chunk", column_path, f"{more} missing, first {missing[0]}")
            continue
        try:
            Table(session / name, files)[group.name]
        except SessionError as error:
            yield Finding("bad-crc", column_path, str(error))
    if len(set(lengths.values())) > 1:
        yield Finding("unequal-lengths", name, f"found {lengths}")


def _check_stream_files(files: Files, session: Path, group: Path) -> Iterator[Finding]:
    """Yield problems in a stream's metadata and leftover files, without reading its data."""
    stream_path = str(group.relative_to(session))
    try:
        layout = StreamLayout.load(group, files)
        spec = _spec_of(layout)
    except SessionError as error:
        yield Finding("metadata", stream_path, str(error))
        return
    if spec is not None:
        yield from _unlike_spec(layout, spec, stream_path)
    unfinished = [path for path in files.listed(group) if layout.is_unfinished(path)]
    sizes = files.sizes(group) if unfinished else {}
    for path in sorted(unfinished):
        code = "torn-tail" if PARTIAL in path.name else "journal-left"
        size = sizes.get(path, 0)
        yield Finding(
            code, stream_path, f"{path.relative_to(session)}, {size} bytes, was left behind"
        )
    lengths = {column.column.name: column.rows() for column in layout.columns}
    if len(set(lengths.values())) > 1:
        yield Finding("unequal-lengths", stream_path, f"found {lengths}")


def _check_chunks(session: Path, layout: ColumnLayout) -> tuple[list[Finding], NDArray[np.uint32]]:
    """Verify every record of a column; return the findings and each chunk's CRC-32C (n,)."""
    column_path = str(layout.path.relative_to(session))
    chunks = math.ceil(layout.rows() / layout.rows_per_chunk)
    shards = math.ceil(chunks / layout.chunks_per_shard)
    # Shards after the last file are missing as well; the first of them stands for all.
    looked_at = min(shards, _last_shard(layout) + 2)
    contents = np.zeros(min(chunks, looked_at * layout.chunks_per_shard), np.uint32)
    faults: dict[str, list[str]] = defaultdict(list)
    for shard in range(looked_at):
        first = shard * layout.chunks_per_shard
        try:
            _check_shard(layout, shard, contents[first : first + layout.chunks_per_shard], faults)
        except SessionError as error:
            faults["missing-chunk" if "missing" in str(error) else "bad-crc"].append(str(error))
    further = shards - looked_at
    findings = [
        Finding(
            code,
            column_path,
            f"{len(messages) + further * (code == 'missing-chunk')} found, first: {messages[0]}",
        )
        for code, messages in faults.items()
    ]
    return findings, contents


def _last_shard(layout: ColumnLayout) -> int:
    """Return the number of the last shard that has a file; -1 without any."""
    root = layout.path / "c"
    names = (path.relative_to(root).parts[0] for path in layout.files.listed(root))
    numbers = (name.removesuffix(PARTIAL) for name in names)
    return max((int(number) for number in numbers if number.isdecimal()), default=-1)


def _check_shard(
    layout: ColumnLayout, shard: int, contents: NDArray[np.uint32], faults: dict[str, list[str]]
) -> None:
    index = layout.index(shard)
    crcs = index.crcs or []
    data = layout.files.read(layout.shard(shard))
    for slot in range(len(contents)):
        number = shard * layout.chunks_per_shard + slot
        row = number * layout.rows_per_chunk
        offset, nbytes = index.ranges[slot]
        if offset == MISSING:
            faults["missing-chunk"].append(f"row {row}")
            continue
        payload = data[offset : offset + nbytes]
        head = data[max(offset - HEADER.size, 0) : offset]
        contents[slot] = crcs[slot]
        content, crc = payload[:-CRC_BYTES], int.from_bytes(payload[-CRC_BYTES:], "little")
        if not (record_matches(head, payload, number) and crc == crcs[slot]):
            faults["bad-crc"].append(f"row {row}")
        # Cameras pad their frames to suit the bus, so the end marker need not come last.
        elif layout.column.codec == "jpeg" and not (
            content.startswith(b"\xff\xd8") and b"\xff\xd9" in content[-1024:]
        ):
            faults["bad-image"].append(f"row {row}")


def _unlike_spec(layout: StreamLayout, spec: StreamSpec, where: str) -> Iterator[Finding]:
    stored = {column.column.name: column.column for column in layout.columns}
    for expected in spec.columns:
        name = f"{where}/{expected.name}"
        column = stored.get(expected.name)
        if column is None:
            message = "column not found"
        elif (column.dtype, column.shape) != (expected.dtype, expected.shape):
            due = f"{expected.dtype} {expected.shape}"
            message = f"found {column.dtype} {column.shape}, expected {due}"
        elif column.units and column.units != expected.units:
            message = f"found units {column.units!r}, expected {expected.units!r}"
        else:
            continue
        yield Finding("wrong-dtype", name, message)


def _spec_of(layout: StreamLayout) -> StreamSpec | None:
    """Return the format's specification of a stream of this kind; None if there is none."""
    shapes = {column.column.name: column.column.shape for column in layout.columns}
    if layout.path.parent.name != "streams":
        reference = reference_spec([_taxels_spec(shapes.get("taxels"))])
        return {"segments": SEGMENTS, "reference": reference}.get(layout.name)
    kind = Traits.read(layout.name, layout.attrs()).kind
    image = layout.image
    if image is not None and kind in ("camera", "depth"):
        height, width = image.column.shape[:2]
        if kind == "depth":
            units = image.column.units
            return depth_spec(60, name=layout.name, height=height, width=width, units=units)
        return camera_spec(60, height=height, width=width, codec=image.column.codec)
    specs = {"force": force_spec(1000), "pose": pose_spec(500)}
    return {**specs, "taxels": _taxels_spec(shapes.get("value"))}.get(kind)


def _taxels_spec(shape: tuple[int, ...] | None) -> StreamSpec:
    """Return the specification of an array of any number of taxels and axes."""
    if shape is None or len(shape) != 2:
        return taxels_spec(60)
    return taxels_spec(60, taxels=shape[0], axes=shape[1])


# Recorded content: times, sequence numbers and values.

# A pause that lost nothing is a gap if it exceeds both this many periods and this duration [s]; one
# that later samples catch up with, as the host was busy, if it exceeds this [s]. Time on either
# side of a pause that tells [s].
GAP_PERIODS, GAP_LEAST, BUSY, TELLS = 3.0, 0.05, 0.15, 1.0
# Equal samples are frozen if they last longer than this [s] and number at least this many.
FROZEN, FROZEN_SAMPLES = 1.0, 5
# A stream may end this long before the last phase [s].
END_MARGIN = 0.25
# A phase may begin this long before a stream does [s].
START_MARGIN = 0.1

# Columns in which NaN means that the device sends no such value.
_NAN_IS_FINE = {"device_t", "speed"}


def check_stream(
    session: Session, stream: Stream, contents: NDArray[np.uint32] | None
) -> Iterator[Finding]:
    """Yield problems of a stream, run by run; `contents` has a checksum (n,) for each image."""
    stream_path = f"streams/{stream.name}"
    account = session.account(stream.name)
    yield from _check_losses(session, stream_path, stream.name, account)
    note = uncalibrated(stream)
    if note is not None and account.rows:
        yield Finding("uncalibrated", stream_path, note)
    for run, losses in enumerate(account.runs):
        rows = session.rows_of_run(stream.name, run)
        stood = stalls(session, run)
        yield from _check_times(session, run, stream, losses, stood)
        still = "still" in (stream.attrs.get("source_motion"), session.attrs.get("source_motion"))
        # A scale repeats one reading while its load rests.
        if stream.traits.defaults.changes and not still and READING not in stream.small:
            images = None if contents is None else contents[: len(stream)][rows]
            values = stream.rows("value", rows) if images is None else images
            yield from _check_frozen(stream_path, stream, rows, values, stood)
    for layout in stream.layout.small:
        name, bad = layout.column.name, []
        if layout.dtype.kind != "f" or name in _NAN_IS_FINE:
            continue
        for part in blocks(len(stream)):
            values = stream.rows(name, part)[:]
            numbers = measured(stream, values) if name == "value" else flat(values)
            missing = np.asarray(~np.isfinite(numbers).all(axis=1))
            if name == "value" and READING in stream.small:
                # A reading that has not settled is kept, and is no value.
                missing &= ~np.isfinite(stream.rows(READING, part)[:])
            bad.append(part.start + np.flatnonzero(missing))
        if any(map(len, bad)):
            rows_of = np.concatenate(bad)
            message = f"{len(rows_of)} rows, first row {rows_of[0]}"
            yield Finding("nan", f"{stream_path}/{name}", message)


def _check_declared(session: Session) -> Iterator[Finding]:
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


def _check_segments(session: Session) -> Iterator[Finding]:
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


def _check_frames(session: Session) -> Iterator[Finding]:
    """Yield a finding if the frames view does not have one row per tick of the segments."""
    if "t_ns" not in session.frames:
        yield Finding("frames-length", "frames", "missing")
        return
    expected = sum(len(ticks) for _, ticks, _ in session.run_ticks(session.rate_hz))
    rows = len(session.frames["t_ns"])
    if rows != expected:
        yield Finding("frames-length", "frames", f"found {rows} rows, expected {expected}")


def _check_losses(session: Session, where: str, name: str, account: Account) -> Iterator[Finding]:
    if account.lost:
        first_row = next(
            (session.rows_of_run(name, run).start or 0) + int(losses.row[0])
            for run, losses in enumerate(account.runs)
            if losses.total
        )
        by = {ARRIVAL: f"arrival at {session.streams[name].rate_hz:g} Hz"}
        message = (
            f"{account.lost} samples lost in {account.gaps} places, counted by "
            f"{by.get(account.source, account.source)}; first before row {first_row}"
        )
        yield Finding("dropped", where, f"{message}; {account.targets_text()}")
    if not account.sees_drops and account.rows:
        yield Finding("drops-unseen", where, unseen(account))


def _check_times(
    session: Session, run: int, stream: Stream, losses: Losses, stood: NDArray[np.int64]
) -> Iterator[Finding]:
    where, rows = f"streams/{stream.name}", session.rows_of_run(stream.name, run)
    first, t_ns, rate_hz = rows.start or 0, stream.rows("t_ns", rows), stream.rate_hz
    if len(t_ns) < 2:
        return
    compressed = is_compressed(session.attrs)
    limit = max(GAP_PERIODS / rate_hz, GAP_LEAST)
    jumped = np.zeros(0, np.intp) if compressed else _clock_steps(stream, rows, losses, limit)
    known = np.concatenate([losses.row - 1, jumped])
    # Rows before a step of each kind, counted in the run, and the steps [s].
    found: dict[str, list[tuple[Array, Array]]] = defaultdict(list)
    for part in blocks(len(t_ns) - 1):
        near = slice(part.start, part.stop + 1)
        times = t_ns[near]
        steps = np.diff(times) * NS
        explained = in_stalls(stood, times[:-1], times[1:])
        explained[known[(known >= part.start) & (known < part.stop)] - part.start] = True
        late = (steps > limit) & ~explained
        busy = np.flatnonzero(late & (steps <= BUSY))
        late[busy] = _stays(stream, rows, losses, part.start + busy, limit)
        kinds = {"time-order": (steps <= 0) & ~explained, "gap": late}
        if losses.source == SEQUENCE:
            kinds["seq-order"] = np.diff(stream.rows("seq", rows)[near]) <= 0
        for code, here in kinds.items():
            found[code].append((part.start + np.flatnonzero(here), steps[here]))
    found["clock-step"] = [(jumped, np.array([(t_ns[k + 1] - t_ns[k]) * NS for k in jumped[:1]]))]
    whole = {code: [*map(np.concatenate, zip(*some, strict=True))] for code, some in found.items()}
    for code, of, digits in (
        ("clock-step", "", 3),
        ("seq-order", "/seq", 0),
        ("time-order", "", 6),
    ):
        at, steps = whole.get(code, (known[:0], known[:0]))
        if at.size:
            by = f", {steps[0]:+.{digits}f} s" if digits else ""
            message = f"{at.size} found, first at row {first + at[0] + 1}{by}"
            yield Finding(code, where + of, message)
    if compressed or losses.source == EVENTS:
        return
    at, steps = whole["gap"]
    if at.size:
        row = first + at[np.argmax(steps)] + 1
        message = f"{at.size} found, longest {steps.max():.3f} s before row {row}"
        yield Finding("gap", where, f"{message}, limit {limit:.3f} s")
    rates = session.runs[run].get("rates_hz") if session.runs else None
    before = rates.get(stream.name) if isinstance(rates, dict) else None
    due_hz = before if isinstance(before, float) and before > 0 else rate_hz
    stretch = other_rate(t_ns, due_hz, losses)
    if stretch is not None:
        row, seconds, measured = stretch
        message = f"{measured:.4g} Hz for {seconds:.1f} s from row {first + row}"
        yield Finding("rate", where, f"{message}, before the recording {due_hz:.4g} Hz")


def _clock_steps(stream: Stream, rows: slice, losses: Losses, limit: float) -> NDArray[np.intp]:
    """Return the rows after which the offset between host and device has changed permanently."""
    # Without a device clock, a step cannot be distinguished from a device that paused: a gap.
    if "device_t" not in stream.small:
        return np.zeros(0, np.intp)
    t_ns, device_t = stream.t_ns[rows], stream.array("device_t")[rows]
    if not np.isfinite(device_t).all():
        return np.zeros(0, np.intp)
    offset = (t_ns - t_ns[0]) * NS - (device_t - device_t[0])
    at = np.flatnonzero(np.abs(np.diff(offset)) > limit)
    return at[_stays(stream, rows, losses, at, limit)]


def _stays(
    stream: Stream, rows: slice, losses: Losses, at: NDArray[np.intp], limit: float
) -> NDArray[np.bool_]:
    """Return True where times stay off those of the device, or of its rate, after rows `at` (n,).

    Samples come late and never early, so the promptest on either side are compared; where there are
    too few of them to tell, it is a delay.
    """
    near, stays = max(4, round(TELLS * stream.rate_hz)), np.zeros(len(at), np.bool_)
    if not len(at):
        return stays
    t_ns, clock = stream.rows("t_ns", rows), witnesses(stream, rows).get("device_t")
    for k, row in enumerate(at.tolist()):
        low, high = max(row + 1 - near, 0), min(row + 1 + near, len(t_ns))
        due = numbers(np.arange(low, high), losses) / stream.rate_hz
        if clock is not None and np.isfinite(clock[low:high]).all():
            due = clock[low:high]
        before, after = np.split((t_ns[low:high] - t_ns[low]) * NS - due, [row + 1 - low])
        shift = float(after.min() - before.min())
        known = len(after if shift > 0 else before)
        stays[k] = abs(shift) > limit / 2 and known > min(abs(shift) * stream.rate_hz + 4, near - 1)
    return stays


def _check_frozen(
    where: str, stream: Stream, rows: slice, values: Array | Rows, stood: NDArray[np.int64]
) -> Iterator[Finding]:
    """Yield stretches of equal values, which are those in `rows` or the checksums of images."""
    ends = np.flatnonzero(np.diff(changed(stream, values))).reshape(-1, 2)
    ends = ends[ends[:, 1] - ends[:, 0] + 1 >= FROZEN_SAMPLES]
    if not len(ends):
        return
    since, until = stream.t_ns[rows][ends.T]
    lasting = (until - since) * NS
    frozen = np.flatnonzero((lasting > FROZEN) & ~in_stalls(stood, since, until))
    if frozen.size:
        worst = frozen[np.argmax(lasting[frozen])]
        message = f"{frozen.size} times, longest {lasting[worst]:.1f} s from row"
        begin = (rows.start or 0) + ends[worst, 0]
        yield Finding("frozen", where, f"{message} {begin}, limit {FROZEN} s")


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
        stream_path = f"streams/{stream.name}"
        t_ns = stream.rows("t_ns", session.rows_of_run(stream.name, run))
        if not len(t_ns):
            yield Finding("truncated", stream_path, f"run {run}: no samples at all")
            continue
        late[int(t_ns[0])] = stream_path
        short = (int(ends[of_run].max()) - int(t_ns[-1])) * NS
        if short > END_MARGIN:
            message = f"run {run}: ends {short:.1f} s before the last phase"
            yield Finding("truncated", stream_path, message)
    if not late:
        return
    lead = (max(late) - starts[of_run]) * NS
    early = np.flatnonzero(lead > START_MARGIN)
    if early.size:
        message = f"row {of_run[early[0]]} starts {lead[early[0]]:.3f} s before {late[max(late)]}"
        yield Finding("segment-outside", "segments", f"{message} does, in run {run}")
