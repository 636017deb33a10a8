"""Read-only access to a session. Takes no lock, changes nothing and never fills in values."""

import os
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.errors import SessionError
from recorder.session.align import Sources
from recorder.session.columns import Stream
from recorder.session.loss import Losses, is_compressed
from recorder.session.window import (
    RunStreams,
    Window,
    align_window,
    sources_near,
    sources_of_run,
    span_of_run,
    ticks_before,
)
from recorder.spec import frame_columns, signal_of
from recorder.store.documents import read_order, read_session_attrs
from recorder.store.files import Files, locate
from recorder.store.manifest import sealed_files
from recorder.store.tables import Table

Array = np.ndarray[Any, Any]


class Session:
    """One recorded session, read-only.

    A session that is still being recorded, or whose writers were killed, shows all rows that are
    complete when it is opened, and has a `warning`; it has no `frames` yet.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        storage_options: Mapping[str, Any] | None = None,
        unsealed: bool = False,
    ) -> None:
        """Open a session.

        Args:
            path: A directory, or a URL that fsspec knows, such as `s3://bucket/x.zarr`.
            storage_options: Options that fsspec needs to open the URL, e.g. `{"anon": True}`.
            unsealed: True to read a closed session although a manifest is lost, with a `warning`;
                its chunks are verified by their checksums, its other files cannot be.
        """
        self.files, self.path = locate(path, storage_options)
        with self.files.remembering():
            self._open(unsealed)

    def _open(self, unsealed: bool) -> None:
        self.attrs = read_session_attrs(self.path, self.files)
        if self.status == "recording" and not self.files.local:
            raise SessionError(
                f"{self.name}: was copied while it was recorded; recover it where it was "
                "recorded (tactile session recover) and copy it again"
            )
        self.files, self._lost_manifest = sealed_files(
            self.files, self.path, self.attrs, unsealed=unsealed
        )
        self.attrs = read_session_attrs(self.path, self.files)
        live = self.status == "recording"
        groups = self.files.groups(self.path / "streams")
        self.streams: Mapping[str, Stream] = {
            group.name: Stream(group, self.files, live=live) for group in groups
        }
        declared = read_order(self.path / "streams", self.files)
        self.order = [name for name in declared if name in self.streams]
        self.order += sorted(self.streams.keys() - set(declared))
        self.targets = Table.of_group(self.path / "targets", self.files)
        self.segments = _table(self.path / "segments", self.files, live)
        self.reference = _table(self.path / "reference", self.files, live)
        self.frames = Table.of_group(self.path / "frames", self.files)
        self._losses: dict[int, dict[str, Losses]] = {}
        self._spans: dict[int, tuple[int, int] | None] = {}

    def __repr__(self) -> str:
        """Return its place, status, sensor, indenter and the rows of its streams."""
        known = (self.attrs.get(key) for key in ("sensor", "indenter"))
        rows = ", ".join(f"{name} {len(stream):,}" for name, stream in self.streams.items())
        parts = [self.status, *(str(each) for each in known if each), rows or "no streams"]
        return f"<Session {self.name}: {', '.join(parts)}>"

    def require_frames(self) -> Table:
        """Return `frames`.

        Raises:
            SessionError: The session has none, such as while it is recorded.
        """
        if "t_ns" not in self.frames:
            live = self.status == "recording"
            raise SessionError(
                f"{self.name}: {'recording, so it has no frames yet' if live else 'has no frames'} "
                "(tactile session recover builds them, once nothing writes to it)"
            )
        return self.frames

    @property
    def name(self) -> str:
        """Location of the session as a path or URL."""
        return self.files.name(self.path)

    @property
    def status(self) -> str:
        """One of `spec.STATUSES`."""
        return str(self.attrs["status"])

    @property
    def runs(self) -> list[dict[str, Any]]:
        """Entries of attrs `runs`, with the `first_row` of each stream."""
        return list(self.attrs["runs"])

    @property
    def warning(self) -> str | None:
        """Warning to show before the session is used, or None."""
        if self._lost_manifest is not None:
            return f"opened without its manifest: {self._lost_manifest}"
        if self.status == "recording":
            return (
                f"{self.name}: still recording, or killed while it was; its rows so far are "
                "visible, frames are not (tactile session recover, once nothing writes to it)"
            )
        return None

    @cached_property
    def rate_hz(self) -> float:
        """Rate of the frames view: attrs `rate_hz`, or else the signal's."""
        if "rate_hz" in self.attrs:
            return float(self.attrs["rate_hz"])
        for name in (self.signal, self.first("pose"), *self.order):
            if name is not None:
                return self.streams[name].rate_hz
        raise SessionError(f"{self.name}: no stream has a rate; set rate_hz")

    @property
    def columns(self) -> dict[str, str]:
        """Column of `frames` and `reference` by stream, in order; see `spec.frame_columns`."""
        return frame_columns([(name, self.streams[name].traits) for name in self.order])

    @property
    def signal(self) -> str | None:
        """Name of the stream that the others are aligned to; None without a signal."""
        return signal_of([(name, self.streams[name].traits) for name in self.order])

    def of_kind(self, kind: str) -> list[str]:
        """Return the names of the streams of a kind, in order."""
        return [name for name in self.order if self.streams[name].traits.kind == kind]

    def first(self, kind: str) -> str | None:
        """Return the name of the first stream of a kind; None if there is none."""
        return next(iter(self.of_kind(kind)), None)

    def rows_of_run(self, name: str, run: int) -> slice:
        """Return the rows of a stream that belong to a run.

        Raises:
            SessionError: No such run.
        """
        if not 0 <= run < max(len(self.runs), 1):
            raise SessionError(f"{self.name}: no run {run}; runs: {len(self.runs)}")
        length = len(self.streams[name])
        first = [int(entry["first_row"].get(name, 0)) for entry in self.runs]
        if not first:
            return slice(0, length)
        return slice(first[run], first[run + 1] if run + 1 < len(first) else length)

    def run_streams(self, run: int) -> RunStreams:
        """Return the streams in order, with their rows and losses of one run."""
        rows = {name: self.rows_of_run(name, run) for name in self.order}
        streams = {name: self.streams[name] for name in self.order}
        counted = self._losses.setdefault(run, {})
        return RunStreams(streams, rows, not is_compressed(self.attrs), counted)

    def sources(self, run: int) -> Sources:
        """Return the streams of one run, ready to be aligned."""
        return sources_of_run(self.run_streams(run))

    def losses(self, name: str, run: int) -> Losses:
        """Return the samples that a stream lost in a run; kept in memory."""
        return self.run_streams(run).losses(name)

    def run_at(self, t_ns: int) -> int:
        """Return the latest run whose samples enclose a time, or else the last run."""
        count = max(len(self.runs), 1)
        for run in reversed(range(count if count > 1 else 0)):
            if run not in self._spans:
                self._spans[run] = span_of_run(self.run_streams(run))
            span = self._spans[run]
            if span is not None and span[0] <= t_ns <= span[1]:
                return run
        return count - 1

    def window(
        self,
        t_ns: int,
        n: int,
        *,
        align: Mapping[str, str] | None = None,
        rate_hz: float | None = None,
        run: int | None = None,
    ) -> Window:
        """Return the last `n` synchronised rows at a time, as a live program would have seen them.

        Args:
            t_ns: Tick of the last row [ns]; the others lie before it, one period apart.
            n: Number of rows.
            align: Methods by stream in place of its own alignment: `latest` or `nearest`, of
                numbers also `interpolated`, and `mean` if they are no poses.
            rate_hz: Rate of the rows; the session's if None.
            run: Run of whose clock `t_ns` is; determined from the samples if None.

        Raises:
            SessionError: An unknown stream or method, or a corrupt stream.
        """
        ticks = ticks_before(t_ns, n, rate_hz or self.rate_hz)
        streams = self.run_streams(self.run_at(t_ns) if run is None else run)
        sources = sources_near(streams, ticks) if n > 0 else sources_of_run(streams)
        rows = align_window(ticks, sources, align)
        shown = {
            name: replace(aligned, value=self._pixels(name, aligned.row))
            for name, aligned in rows.streams.items()
            if aligned.row is not None and self.streams[name].layout.image is not None
        }
        return replace(rows, streams={**rows.streams, **shown})

    def _pixels(self, name: str, rows: NDArray[np.int64]) -> Array:
        """Return the images of some rows (n, h, w, channels); zeros for row -1."""
        stream = self.streams[name]
        column = stream.layout.columns[0].column
        pixels = np.empty((len(rows), *column.shape), column.dtype)
        pixels[rows < 0] = 0
        stream.images_into(rows, pixels)
        return pixels


def _table(path: Path, files: Files, live: bool) -> Table:
    stream = Stream(path, files, live=live)
    return Table(path, stream.names, stream.array)
