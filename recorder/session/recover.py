"""Puts a session back in order after its writers were killed or the power failed."""

import os
from dataclasses import dataclass
from pathlib import Path

from recorder.session.frames import remove_leftovers, write_frames
from recorder.session.reader import Session
from recorder.session.stream_writer import StreamWriter, survey
from recorder.store.durable import TEMPORARY
from recorder.store.layout import StreamLayout, merge_attrs, read_session_attrs


@dataclass(frozen=True, slots=True)
class StreamRecovery:
    """What was found in one stream."""

    name: str
    """Path of the stream inside the session."""
    rows: int
    """Rows it holds now."""
    recovered_rows: int
    """Rows of them that no Zarr reader saw before."""
    torn_bytes: int
    """Bytes of records that were never finished."""
    dropped_rows: int
    """Rows that some columns held and others did not."""
    touched: bool
    """Whether anything had to be done."""


@dataclass(frozen=True, slots=True)
class Recovery:
    """What was found in a session, and what it is now."""

    streams: tuple[StreamRecovery, ...]
    """Every stream and table."""
    frames_rebuilt: bool
    """Whether the frames view was built anew."""
    status: str
    """Status of the session now."""

    @property
    def touched(self) -> bool:
        """Whether anything had to be done."""
        return self.frames_rebuilt or any(stream.touched for stream in self.streams)


def recover(path: str | os.PathLike[str]) -> Recovery:
    """Close a session that was not closed: seal its streams, build `frames`, set its status.

    A session that was `recording` becomes `recovered`, another keeps its status. Nothing is done to
    a sound session, so it may be repeated; killed half-way, it can be run again.

    Raises:
        SessionError: Not a session, one that is being written, or one damaged beyond what a crash
            does.
    """
    session = Path(path)
    attrs = read_session_attrs(session)
    status = str(attrs.get("status"))
    (session / f"zarr.json{TEMPORARY}").unlink(missing_ok=True)
    leftovers = remove_leftovers(session)
    streams = recover_streams(session)
    touched = leftovers or any(stream.touched for stream in streams)
    rebuild = touched or status == "recording" or not (session / "frames").exists()
    if rebuild:
        write_frames(session, Session(session).rate_hz)
    if status == "recording":
        status = "recovered"
        merge_attrs(session, {"status": status})
    return Recovery(tuple(streams), rebuild, status)


def recover_streams(path: Path) -> list[StreamRecovery]:
    """Seal every stream and table of a session that was not closed.

    Raises:
        SessionError: A stream is being written, or is damaged beyond what a crash does.
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
