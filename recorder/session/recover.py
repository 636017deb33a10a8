"""Recover the streams of a session after its writers were killed or the power failed."""

from dataclasses import dataclass
from pathlib import Path

from recorder.session.stream_writer import StreamWriter, survey
from recorder.store.layout import StreamLayout


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


def recover_streams(path: Path) -> list[StreamRecovery]:
    """Seal every stream and table of a session that was not closed."""
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
