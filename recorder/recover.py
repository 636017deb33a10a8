"""Puts a session back in order after its writers were killed or the power failed."""

from dataclasses import dataclass
from pathlib import Path

from recorder.layout import StreamLayout
from recorder.restore import survey
from recorder.writer import StreamWriter


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
