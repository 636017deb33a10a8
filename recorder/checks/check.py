"""Check a session or a marker archive for every known problem, read-only."""

import os
from collections.abc import Iterator
from pathlib import Path

from recorder.archive.check import check_archive
from recorder.archive.plan import FORMAT as ARCHIVE
from recorder.checks.content import (
    check_declared,
    check_frames,
    check_segments,
    check_stream,
)
from recorder.checks.integrity import (
    check_arrays,
    check_chunks,
    check_manifest,
    check_stream_files,
    check_table,
)
from recorder.errors import SessionError
from recorder.findings import Finding
from recorder.session.reader import Session
from recorder.store.attributes import read_session_attrs, says_it_is
from recorder.store.files import Files, locate
from recorder.store.layout import StreamLayout
from recorder.store.manifest import GROUP


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
    for finding in check_manifest(files, path, attrs):
        yield finding
        # Without its manifest, a session can still be read.
        broken |= finding.code == "manifest" and finding.where != GROUP
    if quick:
        return
    unreadable: set[str] = set()
    for finding in check_arrays(files, path):
        yield finding
        if finding.code == "metadata":
            unreadable.add(finding.where)
    if unreadable:
        return
    contents = {}
    groups = files.groups(path / "streams")
    for group in (*groups, path / "segments", path / "reference"):
        findings = list(check_stream_files(files, path, group))
        if not any(finding.code in ("metadata", "wrong-dtype") for finding in findings):
            for layout in StreamLayout.load(group, files).columns:
                damage, crcs = check_chunks(path, layout)
                findings += damage
                if layout.column.is_image:
                    contents[group.name] = crcs
        yield from findings
        if any(finding.code not in ("torn-tail", "journal-left") for finding in findings):
            unreadable.add(group.name)
    damaged_tables = set()
    for name in ("targets", "frames"):
        for finding in check_table(files, path, name):
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
