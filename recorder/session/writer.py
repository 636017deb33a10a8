"""Create a session, add runs to it, and close it."""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np

from recorder import spec
from recorder.errors import SessionError
from recorder.session.clocks import fit_clocks
from recorder.session.frames import write_frames
from recorder.session.stream_writer import StreamWriter, recover_streams, survey
from recorder.store import documents
from recorder.store.files import building, sync_tree
from recorder.store.layout import StreamLayout, create_stream, write_table
from recorder.store.manifest import hold, remove_unfinished, seal


class SessionWriter:
    """Writer of a session's attributes, runs and tables.

    It does not write the streams: each has its own `StreamWriter`, usually in a separate process,
    opened with `stream_path(name)`.
    """

    segments: StreamWriter
    """One row per recorded phase, columns of `SEGMENTS`."""
    reference: StreamWriter
    """One row per no-contact moment, columns of `spec.reference_spec`."""

    def __init__(self, path: Path) -> None:
        """Use `create` or `resume` instead."""
        self.path = path
        self.segments = StreamWriter.open(path / "segments")
        try:
            self.reference = StreamWriter.open(path / "reference")
        except BaseException:
            self.segments.close()
            raise

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        *,
        attrs: dict[str, Any],
        streams: Sequence[spec.StreamSpec],
        targets: Mapping[str, np.ndarray[Any, Any]],
    ) -> Self:
        """Create a session with empty streams, status `recording`.

        Args:
            path: Directory to create; must not exist.
            attrs: Attributes of the session; `format`, `status` and `runs` are added.
            streams: Streams to record; the name is that of the group below `streams`.
            targets: Columns of the targets, one row per target.

        Raises:
            SessionError: `path` exists, or an argument cannot be stored.
        """
        final = Path(path)
        if not final.name.isprintable():
            raise SessionError(f"{str(final)!r}: allowed as a name: printable characters alone")
        if final.exists():
            raise SessionError(f"{final}: exists already; resume it or choose another name")
        spec.check_streams(streams)
        _check_written(attrs, final)
        final.parent.mkdir(parents=True, exist_ok=True)
        with building(final) as beside:
            _build(beside, attrs, streams, targets)
        return cls(final)

    @classmethod
    def resume(cls, path: str | os.PathLike[str]) -> Self:
        """Open a session to add a run, first recovering it if it was not closed.

        Raises:
            SessionError: Not a session, or one that is being written.
        """
        session = Path(path)
        attrs = documents.read_session_attrs(session)
        remove_unfinished(session)
        hold(session, attrs)
        recover_streams(session)
        if attrs["status"] == "recording":  # the run that was not closed
            seal(session)
        documents.merge_attrs(session, {"status": "recording", "reason": ""})
        return cls(session)

    def begin_run(self, entry: dict[str, Any]) -> None:
        """Add a run, before its streams are opened.

        Its attributes are above all its clock anchor `t0_ns`, `utc` and `boot_id`; `first_row`, its
        first row in each stream, is added.
        """
        names = [*_stream_names(self.path)]
        first_row = {name: survey(StreamLayout.load(self.stream_path(name))).rows for name in names}
        first_row |= {"segments": self.segments.rows, "reference": self.reference.rows}
        runs = documents.read_session_attrs(self.path)["runs"]
        _check_written({"runs": [entry]}, self.path)
        documents.merge_attrs(self.path, {"runs": [*runs, {**entry, "first_row": first_row}]})

    def end_run(self, entry: dict[str, Any]) -> None:
        """Add attributes to the entry of the last run.

        Raises:
            SessionError: An attribute that readers would refuse.
        """
        runs = documents.read_session_attrs(self.path)["runs"]
        self.set_attrs(runs=[*runs[:-1], {**runs[-1], **entry}])

    def stream_path(self, name: str) -> Path:
        """Return the group of a stream, to be opened by a `StreamWriter`.

        Raises:
            SessionError: The session has no such stream.
        """
        names = _stream_names(self.path)
        if name not in names:
            raise SessionError(f"{self.path}: no stream {name!r}; known: {', '.join(names)}")
        return self.path / "streams" / name

    def set_attrs(self, **attrs: Any) -> None:
        """Merge into the session's attributes, atomically.

        Raises:
            SessionError: An attribute that readers would refuse.
        """
        _check_written(attrs, self.path)
        documents.merge_attrs(self.path, attrs)

    def finish(
        self, status: str, reason: str = "", *, rate_hz: float, clocks: bool = False
    ) -> None:
        """Close the session: write the tables, the frames view, the manifest, then the status.

        Streams whose process died are recovered. May be repeated after an error. From then on no
        file of the session may change, except by `resume`.

        Args:
            status: `complete`, `stopped` or `recovered`.
            reason: Reason in a few words.
            rate_hz: Rate of the frames view.
            clocks: True to fit the devices' clocks first; see `fit_clocks`.

        Raises:
            SessionError: An unknown status, or a stream that is still being written.
        """
        final = spec.STATUSES[1:]
        if status not in final:
            raise SessionError(f"found status {status!r}, expected one of {', '.join(final)}")
        self.close()
        recover_streams(self.path)
        documents.merge_attrs(self.path, {"rate_hz": float(rate_hz)})
        if clocks:
            fit_clocks(self.path)
        write_frames(self.path, rate_hz)
        seal(self.path, status=status, reason=reason)

    def close(self) -> None:
        """Close the tables and leave the status unchanged. May be called twice."""
        try:
            self.segments.close()
        finally:
            self.reference.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _check_written(attrs: dict[str, Any], path: Path) -> None:
    """Reject attributes that readers would refuse."""
    documents.check_session_attrs(json.loads(documents.json_bytes(path, attrs)), str(path))


def _stream_names(path: Path) -> list[str]:
    root = path / "streams"
    return sorted(entry.name for entry in root.iterdir() if (entry / "zarr.json").exists())


def _build(
    path: Path,
    attrs: dict[str, Any],
    streams: Sequence[spec.StreamSpec],
    targets: Mapping[str, np.ndarray[Any, Any]],
) -> None:
    path.mkdir()
    fixed = {
        "format": spec.FORMAT,
        "format_version": spec.FORMAT_VERSION,
        "status": "recording",
        "runs": [],
    }
    documents.write_group(path, {**attrs, **fixed}, durable=False)
    (path / "streams").mkdir()
    documents.write_group(
        path / "streams", {"order": [stream.name for stream in streams]}, durable=False
    )
    for stream in streams:
        create_stream(path / "streams" / stream.name, stream)
    create_stream(path / "segments", spec.SEGMENTS)
    create_stream(path / "reference", spec.reference_spec(streams))
    write_table(path / "targets", targets, spec.TARGET_UNITS)
    sync_tree(path)
