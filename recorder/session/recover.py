"""Recover a session after its writers were killed or the power failed."""

import os
from dataclasses import dataclass
from pathlib import Path

from recorder.errors import SessionError
from recorder.session.frames import remove_leftovers, write_frames
from recorder.session.reader import Session
from recorder.session.stream_writer import StreamWriter, survey
from recorder.store.files import LOCAL
from recorder.store.layout import REBUILDING, StreamLayout, read_session_attrs
from recorder.store.manifest import remove_unfinished, reopen, seal, wrong_files


@dataclass(frozen=True, slots=True)
class StreamRecovery:
    """Result of recovering one stream."""

    name: str
    """Path of the stream inside the session."""
    rows: int
    """Number of rows now."""
    recovered_rows: int
    """Number of rows that no Zarr reader saw before."""
    torn_bytes: int
    """Bytes of incomplete records."""
    dropped_rows: int
    """Number of rows that only some columns had."""
    touched: bool
    """True if the stream was changed."""


@dataclass(frozen=True, slots=True)
class Recovery:
    """Result of recovering a session."""

    streams: tuple[StreamRecovery, ...]
    """Every stream and table."""
    frames_rebuilt: bool
    """True if the frames view was rebuilt."""
    status: str
    """Status of the session now."""

    @property
    def touched(self) -> bool:
        """True if the session was changed."""
        return self.frames_rebuilt or any(stream.touched for stream in self.streams)


def recover(path: str | os.PathLike[str]) -> Recovery:
    """Close a session that was not closed: seal its streams, build `frames`, set its status.

    A session in status `recording` becomes `recovered`, any other keeps its status. A valid session
    is not changed, so the call is idempotent; if killed half-way, it can be repeated. Of a closed
    session only `frames`, which contain no original data, are built again.

    Raises:
        SessionError: Not a session, one that is being written, or damage that a crash cannot cause.
    """
    session = Path(path)
    attrs = read_session_attrs(session)
    status = str(attrs.get("status"))
    remove_unfinished(session)
    wrong = list(wrong_files(LOCAL, session, attrs))
    for key, text in wrong:
        if status == "recording" or not key.startswith("frames"):
            raise SessionError(f"{session / key}: {text}")
    leftovers = remove_leftovers(session)
    streams = recover_streams(session)
    touched = leftovers or any(stream.touched for stream in streams)
    rebuild = bool(touched or wrong or status == "recording" or not (session / "frames").exists())
    if rebuild:
        if status == "recording":
            status = attrs.get(REBUILDING, "recovered")
        elif wrong:  # its streams can be read, and it can be sealed, only if it is open
            reopen(session, status)
        write_frames(session, Session(session).rate_hz)
        seal(session, status=status)
    return Recovery(tuple(streams), rebuild, status)


def recover_streams(path: Path) -> list[StreamRecovery]:
    """Seal every stream and table of a session that was not closed.

    Raises:
        SessionError: A stream is being written, or has damage that a crash cannot cause.
    """
    groups = sorted(entry.parent for entry in (path / "streams").glob("*/zarr.json"))
    return [_recover(path, group) for group in (*groups, path / "segments", path / "reference")]


def _recover(session: Path, group: Path) -> StreamRecovery:
    layout = StreamLayout.load(group)
    state = survey(layout)
    seen = min(column.rows() for column in layout.columns)
    touched = bool(state.unfinished or state.dropped_rows)
    if touched:
        StreamWriter.open(group).close()
    return StreamRecovery(
        str(group.relative_to(session)),
        state.rows,
        state.rows - min(seen, state.rows),
        state.torn_bytes,
        state.dropped_rows,
        touched,
    )
