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

from recorder.archive.check import check_archive
from recorder.archive.plan import FORMAT as ARCHIVE
from recorder.checks.content import check_declared, check_frames, check_segments, check_stream
from recorder.errors import SessionError
from recorder.findings import Finding
from recorder.session.reader import Session
from recorder.session.stream_writer import is_unfinished
from recorder.spec import (
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
from recorder.store.array import CRC_BYTES, MISSING, check_shape
from recorder.store.attributes import read_session_attrs, says_it_is
from recorder.store.files import Files, locate, read_document
from recorder.store.journal import HEADER, record_matches
from recorder.store.layout import PARTIAL, Layout, StreamLayout
from recorder.store.manifest import GROUP, wrong_files
from recorder.store.reader import Table


def check(path: str | os.PathLike[str], *, quick: bool = False) -> list[Finding]:
    """Return the faults of a session or a marker archive, and notes on what it cannot tell.

    Each finding states its `level`: `fault` or `note`. Unreadable data is reported once and its
    content is not checked. `quick` holds only metadata and the ends of shards against the manifest:
    it takes seconds and finds files that were removed, added or exchanged, but not each flipped
    bit.

    Raises:
        SessionError: Neither a session nor an archive, or `quick` for an archive.
    """
    files, place = locate(path)
    if says_it_is(place, files, ARCHIVE):
        if quick:
            raise SessionError(f"{path}: a marker archive has no manifest; check it without quick")
        return list(check_archive(files, place))
    return list(_check(path, files, place, quick))


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
                if layout.column.is_image:
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
        yield from check_declared(session)
        for name, stream in session.streams.items():
            if name not in unreadable:
                yield from check_stream(session, stream, contents.get(name))
        if not unreadable and "targets" not in damaged_tables:
            yield from check_segments(session)
        if "segments" not in unreadable and "frames" not in damaged_tables:
            yield from check_frames(session)
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
        where = str(path.parent.relative_to(session))
        try:
            document = read_document(files, path)
        except SessionError as error:
            yield Finding("metadata", where, str(error))
            continue
        units = document.get("attributes", {}).get("units")
        if document.get("node_type") == "array" and not units:
            yield Finding("missing-units", where, f"found units {units!r}")


def _check_table(files: Files, session: Path, name: str) -> Iterator[Finding]:
    """Yield missing and corrupt chunks, and unequal lengths, in a group written in one go."""
    lengths = {}
    there = set(files.listed(session / name))
    for group in files.groups(session / name):
        where = f"{name}/{group.name}"
        document = read_document(files, group / "zarr.json")
        try:
            shape, chunk = document["shape"], document["chunk_grid"]["configuration"]["chunk_shape"]
            check_shape(shape, document["data_type"], str(group))
            counts = [range(math.ceil(s / c)) for s, c in zip(shape, chunk, strict=True)]
        except (KeyError, TypeError, ValueError, ZeroDivisionError, SessionError) as error:
            yield Finding("metadata", where, f"not a column of a table: {error!r}")
            continue
        lengths[group.name] = shape[0]
        keys = (group.joinpath("c", *map(str, place)) for place in product(*counts))
        # One more than the files that exist: at least one of them is missing then.
        some = list(islice(keys, len(there) + 1))
        missing = [key for key in some if key not in there]
        if missing:
            more = math.prod(map(len, counts)) - len(some) + len(missing)
            yield Finding("missing-chunk", where, f"{more} missing, first {missing[0]}")
            continue
        try:
            Table.of_group(session / name, files)[group.name]
        except SessionError as error:
            yield Finding("bad-crc", where, str(error))
    if len(set(lengths.values())) > 1:
        yield Finding("unequal-lengths", name, f"found {lengths}")


def _check_stream_files(files: Files, session: Path, group: Path) -> Iterator[Finding]:
    """Yield problems in a stream's metadata and leftover files, without reading its data."""
    where = str(group.relative_to(session))
    try:
        layout = StreamLayout.load(group, files)
        spec = _spec_of(layout)
    except SessionError as error:
        yield Finding("metadata", where, str(error))
        return
    if spec is not None:
        yield from _unlike_spec(layout, spec, where)
    unfinished = [path for path in files.listed(group) if is_unfinished(layout, path)]
    sizes = files.sizes(group) if unfinished else {}
    for path in sorted(unfinished):
        code = "torn-tail" if PARTIAL in path.name else "journal-left"
        size = sizes.get(path, 0)
        yield Finding(code, where, f"{path.relative_to(session)}, {size} bytes, was left behind")
    lengths = {column.column.name: column.rows() for column in layout.columns}
    if len(set(lengths.values())) > 1:
        yield Finding("unequal-lengths", where, f"found {lengths}")


def _check_chunks(session: Path, layout: Layout) -> tuple[list[Finding], NDArray[np.uint32]]:
    """Verify every record of a column; return the findings and each chunk's CRC-32C (n,)."""
    where = str(layout.path.relative_to(session))
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
            where,
            f"{len(messages) + further * (code == 'missing-chunk')} found, first: {messages[0]}",
        )
        for code, messages in faults.items()
    ]
    return findings, contents


def _last_shard(layout: Layout) -> int:
    """Return the number of the last shard that has a file; -1 without any."""
    root = layout.path / "c"
    names = (path.relative_to(root).parts[0] for path in layout.files.listed(root))
    numbers = (name.removesuffix(PARTIAL) for name in names)
    return max((int(number) for number in numbers if number.isdecimal()), default=-1)


def _check_shard(
    layout: Layout, shard: int, contents: NDArray[np.uint32], faults: dict[str, list[str]]
) -> None:
    index = layout.index(shard)
    crcs = index.crcs or []
    data = layout.files.read(layout.shard(shard))
    for place in range(len(contents)):
        number = shard * layout.chunks_per_shard + place
        row = number * layout.rows_per_chunk
        offset, nbytes = (int(value) for value in index.entries[place])
        if offset == MISSING:
            faults["missing-chunk"].append(f"row {row}")
            continue
        payload = data[offset : offset + nbytes]
        head = data[max(offset - HEADER.size, 0) : offset]
        contents[place] = crcs[place]
        content, crc = payload[:-CRC_BYTES], int.from_bytes(payload[-CRC_BYTES:], "little")
        if not (record_matches(head, payload, number) and crc == crcs[place]):
            faults["bad-crc"].append(f"row {row}")
        # Cameras pad their frames to suit the bus, so the end marker need not come last.
        elif layout.column.codec == "jpeg" and not (
            content.startswith(b"\xff\xd8") and b"\xff\xd9" in content[-1024:]
        ):
            faults["bad-image"].append(f"row {row}")


def _unlike_spec(layout: StreamLayout, spec: StreamSpec, where: str) -> Iterator[Finding]:
    found = {column.column.name: column.column for column in layout.columns}
    for expected in spec.columns:
        name = f"{where}/{expected.name}"
        column = found.get(expected.name)
        if column is None:
            yield Finding("wrong-dtype", name, "column not found")
        elif (column.dtype, column.shape) != (expected.dtype, expected.shape):
            yield Finding(
                "wrong-dtype",
                name,
                f"found {column.dtype} {column.shape}, expected {expected.dtype} {expected.shape}",
            )
        elif column.units and column.units != expected.units:
            yield Finding(
                "wrong-dtype", name, f"found units {column.units!r}, expected {expected.units!r}"
            )


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
    known = {"force": force_spec(1000), "pose": pose_spec(500)}
    return {**known, "taxels": _taxels_spec(shapes.get("value"))}.get(kind)


def _taxels_spec(shape: tuple[int, ...] | None) -> StreamSpec:
    """Return the specification of an array of any number of taxels and axes."""
    if shape is None or len(shape) != 2:
        return taxels_spec(60)
    return taxels_spec(60, taxels=shape[0], axes=shape[1])
