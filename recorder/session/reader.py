"""Read-only access to a session. Takes no lock, changes nothing and never fills in values.

A chunk that is declared but missing is an error here; a plain Zarr reader returns fill values.
"""

import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from recorder.errors import SessionError
from recorder.session.align import Sources, sources_of_run
from recorder.session.loss import Losses, is_compressed, stream_losses
from recorder.session.nearby import Arrivals, sources_near, span_of_run
from recorder.session.tail import LiveRows, LiveStream
from recorder.session.window import Window, align_window, ticks_before
from recorder.spec import Column, Traits, frame_columns, in_order, signal_of
from recorder.store import images
from recorder.store.column import ColumnReader, LazyRows
from recorder.store.files import LOCAL, Files, locate
from recorder.store.layout import StreamLayout, read_order, read_session_attrs
from recorder.store.manifest import sealed_files
from recorder.store.recent import Kept
from recorder.store.tables import Table

Array = np.ndarray[Any, Any]


@dataclass(frozen=True, slots=True)
class StreamRow:
    """One row of a stream."""

    stream: str
    """Name of the stream."""
    number: int
    """Number of the row in the stream."""
    columns: dict[str, Any]
    """Value of each column; an image as its pixels (h, w, channels)."""


class Stream:
    """One stream of a session: columns of equal length, as recorded."""

    def __init__(self, path: Path, files: Files = LOCAL, *, live: bool = False) -> None:
        """Open a stream; use `Session.streams` instead.

        Args:
            path: Group of the stream.
            files: Access to its files.
            live: True to include the rows that are not sealed yet, up to this moment.

        Raises:
            SessionError: Not a stream.
        """
        self.layout = StreamLayout.load(path, files)
        self.name = path.name
        self.attrs = self.layout.attrs()
        self.traits = Traits.read(self.name, self.attrs)
        self._readers = {layout.column.name: ColumnReader(layout) for layout in self.layout.columns}
        self._rows = min(reader.rows for reader in self._readers.values())
        self._live: LiveRows | None = None
        self._tail: LiveStream | None = None
        if live:
            self._tail = LiveStream(self.layout)
            for name, column in self._tail.columns.items():
                self._readers[name].growing = column
        self.refresh()

    def refresh(self) -> None:
        """Show the rows that were recorded since; reads only what was added. No effect if closed.

        Raises:
            SessionError: A sealed shard is corrupt.
        """
        self._columns: Kept[Array] = Kept()
        self._arrivals: dict[tuple[int, int], Arrivals] = {}
        if self._tail is None:
            return
        self._live = self._tail.update()
        self._rows = self._live.rows
        for reader in self._readers.values():
            reader.rows = self._rows if reader.layout.column.is_image else self._live.stored

    def __len__(self) -> int:
        """Return the number of rows that every column has."""
        return self._rows

    def __repr__(self) -> str:
        """Return its name, number of rows and columns."""
        return f"<Stream {self.name}: {len(self):,} rows of {', '.join(self.names)}>"

    @property
    def small(self) -> tuple[str, ...]:
        """Names of the columns that `array` returns: all but the images."""
        return tuple(layout.column.name for layout in self.layout.small)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""
        return tuple(self._readers)

    @property
    def value_column(self) -> Column | None:
        """The column `value`; None in a table."""
        reader = self._readers.get("value")
        return None if reader is None else reader.layout.column

    @property
    def rate_hz(self) -> float:
        """Nominal rate."""
        return float(self.attrs["rate_hz"])

    @property
    def t_ns(self) -> NDArray[np.int64]:
        """Time of each row (n,) int64 [ns], the monotonic clock of its run."""
        return self.array(self.layout.time.column.name)

    def array(self, name: str) -> Array:
        """Return a small column (n, ...), which is kept in memory as long as there is room.

        Raises:
            SessionError: No such column, an image column, or a corrupt chunk.
        """
        reader = self._reader(name)
        if reader.layout.column.is_image:
            raise SessionError(f"{self.name}.{name}: use images(rows) for images")
        found = self._columns.get(name)
        if found is None:
            found = self._columns.put(name, self.rows_between(name, 0, self._rows))
        return found

    def column(self, name: str) -> Array | zarr.Array[Any]:
        """Return a column: in memory, or the Zarr array for images (possibly longer than `len`).

        Raises:
            SessionError: No such column, or a corrupt chunk.
        """
        reader = self._reader(name)
        if reader.layout.column.is_image:
            return reader.layout.files.array(reader.layout.path)
        return self.array(name)

    def rows_between(self, name: str, start: int, stop: int) -> Array:
        """Return rows [start, stop) (n, ...) of a small column, reading only their chunks.

        Raises:
            SessionError: No such column, an image column, or a corrupt chunk.
        """
        reader = self._reader(name)
        if reader.layout.column.is_image:
            raise SessionError(f"{self.name}.{name}: use images(rows) for images")
        found = reader.rows_between(start, min(stop, self._rows))
        if self._live is None or stop <= self._live.stored:
            return found
        stored = self._live.stored
        rest = self._live.journalled[name][max(start - stored, 0) : max(stop - stored, 0)]
        return np.concatenate([found, rest])

    def values(self, rows: slice) -> Array | LazyRows:
        """Return rows of the column `value` (n, ...): in memory, or read lazily if remote."""
        reader = self._reader("value")
        if reader.layout.files.local:
            return self.array("value")[rows]
        return LazyRows(reader, rows)

    def arrivals(self, first: int, last: int) -> Arrivals:
        """Return the arrival times of rows [first, last), those of one run, for a search."""
        key = (first, last)
        if key not in self._arrivals:
            self._arrivals[key] = Arrivals(self, first, last)
        return self._arrivals[key]

    def images(self, rows: Sequence[int] | NDArray[np.integer[Any]] | slice) -> images.Image:
        """Return images (n, h, w, channels): uint8 RGB or grey, or uint16 of a depth camera.

        Raises:
            SessionError: No images here, a row outside the stream, or a corrupt image.
        """
        column = self._image().layout.column
        numbers = np.arange(self._rows)[rows] if isinstance(rows, slice) else np.asarray(rows)
        if len(numbers):
            self._checked(int(numbers.min()))
        out = np.empty((len(numbers), *column.shape), column.dtype)
        self.images_into(numbers, out)
        return out

    def images_into(self, rows: NDArray[np.integer[Any]], out: Array) -> None:
        """Decode images into an array, which may be used again and again.

        Args:
            rows: Rows (n,); -1 leaves the image in its place as it is.
            out: Images (n, h, w, channels), C-contiguous, of the type that `images` returns.

        Raises:
            SessionError: No images here, a row outside the stream, or a corrupt image.
        """
        image = self._image()
        column = image.layout.column
        expected = (len(rows), *column.shape)
        if out.shape != expected or out.dtype != column.dtype or not out.flags.c_contiguous:
            raise SessionError(
                f"{self.name}: found out {out.dtype} {out.shape}, expected {column.dtype} "
                f"{expected}, contiguous"
            )
        if len(rows):
            self._checked(max(int(np.max(rows)), 0))
        image.read_images(np.asarray(rows).tolist(), out)

    def rows_from(self, start: int) -> Iterator[StreamRow]:
        """Yield the rows from `start` on."""
        columns = {name: self.rows_between(name, start, self._rows) for name in self.small}
        for place in range(max(self._rows - start, 0)):
            values = {name: column[place] for name, column in columns.items()}
            if self.layout.image is not None:
                values[self.layout.image.column.name] = self.images([start + place])[0]
            yield StreamRow(self.name, start + place, values)

    def jpeg(self, row: int) -> bytes | None:
        """Return the camera's original bytes of one image, or None if it was stored losslessly.

        Raises:
            SessionError: No images here, or a row outside the stream.
        """
        image = self._image()
        if image.layout.column.codec != "jpeg":
            return None
        return image.chunk(self._checked(row))

    @property
    def jpeg_shape(self) -> tuple[int, ...] | None:
        """Shape (h, w, channels) of images kept as JPEG bytes; None for any other stream."""
        image = self.layout.image
        return image.column.shape if image is not None and image.column.codec == "jpeg" else None

    def jpegs(self, rows: Sequence[int]) -> Iterator[bytes]:
        """Yield the camera's original bytes of some images, fetched concurrently if remote.

        Raises:
            SessionError: No images, images not stored as JPEG, or a row outside the stream.
        """
        image = self._image()
        if image.layout.column.codec != "jpeg":
            raise SessionError(f"{self.name}: images are stored as pixels, without JPEG bytes")
        return image.chunks([self._checked(int(row)) for row in rows])

    def _reader(self, name: str) -> ColumnReader:
        if name not in self._readers:
            raise SessionError(f"{self.name}: no column {name!r}; known: {', '.join(self.names)}")
        return self._readers[name]

    def _image(self) -> ColumnReader:
        if self.layout.image is None:
            raise SessionError(f"{self.name}: has no images; columns: {', '.join(self.names)}")
        return self._readers[self.layout.image.column.name]

    def _checked(self, row: int) -> int:
        if not 0 <= row < self._rows:
            raise SessionError(f"{self.name}: no row {row}, the stream has {self._rows}")
        return row


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

        Raises:
            SessionError: Not a session, a newer format, unreachable, remote and unfinished, or its
                files differ from its manifest. Data that differ are refused when they are read.
        """
        self.files, self.path = locate(path, storage_options)
        with self.files.remembering():
            self._open(unsealed)

    def _open(self, unsealed: bool) -> None:
        self.attrs = read_session_attrs(self.path, self.files)
        if self.status == "recording" and not self.files.local:
            raise SessionError(
                f"{self.name}: was copied while it was recorded; recover it where it was "
                "recorded (python -m recorder recover) and copy it again"
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
        self.order = in_order(self.streams, read_order(self.path / "streams", self.files))
        self.targets = Table.of_group(self.path / "targets", self.files)
        self.segments = _table(self.path / "segments", self.files, live)
        self.reference = _table(self.path / "reference", self.files, live)
        self.frames = Table.of_group(self.path / "frames", self.files)
        self._losses: dict[tuple[str, int], Losses] = {}
        self._spans: dict[int, tuple[int, int] | None] = {}

    def __repr__(self) -> str:
        """Return its place, status, sensor, indenter and the rows of its streams."""
        known = (self.attrs.get(key) for key in ("sensor", "indenter"))
        rows = ", ".join(f"{name} {len(stream):,}" for name, stream in self.streams.items())
        parts = [self.status, *(str(each) for each in known if each), rows or "no streams"]
        return f"<Session {self.name}: {', '.join(parts)}>"

    def _repr_html_(self) -> str:
        """Return a table of the streams and some pictures, for notebooks."""
        from recorder.session.notebook import html_of

        return html_of(self)

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

    def to_pandas(self) -> Any:
        """Return `frames` as a DataFrame; see `recorder.session.tables.to_pandas`."""
        from recorder.session.tables import to_pandas

        return to_pandas(self)

    def to_xarray(self) -> Any:
        """Return `frames` as a Dataset; see `recorder.session.tables.to_xarray`."""
        from recorder.session.tables import to_xarray

        return to_xarray(self)

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
                "visible, frames are not (python -m recorder recover, once nothing writes to it)"
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
        return frame_columns((name, self.streams[name].traits) for name in self.order)

    @property
    def signal(self) -> str | None:
        """Name of the stream that the others are aligned to; None without a signal."""
        return signal_of((name, self.streams[name].traits) for name in self.order)

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

    def sources(self, run: int) -> Sources:
        """Return the streams of one run, ready to be aligned."""
        rows = {name: self.rows_of_run(name, run) for name in self.streams}
        losses = {name: self.losses(name, run) for name in self.columns}
        return sources_of_run(self.streams, self.order, rows, losses)

    def losses(self, name: str, run: int) -> Losses:
        """Return the samples that a stream lost in a run; kept in memory."""
        key = (name, run)
        if key not in self._losses:
            timed = not is_compressed(self.attrs)
            rows = self.rows_of_run(name, run)
            self._losses[key] = stream_losses(self.streams[name], rows, timed=timed)
        return self._losses[key]

    def run_at(self, t_ns: int) -> int:
        """Return the latest run whose samples enclose a time, or else the last run."""
        count = max(len(self.runs), 1)
        for run in reversed(range(count if count > 1 else 0)):
            if run not in self._spans:
                self._spans[run] = span_of_run(self, run)
            span = self._spans[run]
            if span is not None and span[0] <= t_ns <= span[1]:
                return run
        return count - 1

    def window(
        self,
        t_ns: int,
        n: int,
        *,
        image: str | None = None,
        force: str | None = None,
        pose: str | None = None,
        taxels: str | None = None,
        align: Mapping[str, str] | None = None,
        rate_hz: float | None = None,
        run: int | None = None,
    ) -> Window:
        """Return the last `n` synchronised rows at a time, as a live program would have seen them.

        Args:
            t_ns: Tick of the last row [ns]; the others lie before it, one period apart.
            n: Number of rows.
            image: Method for images instead of their own alignment: `latest` or `nearest`.
            force: `mean`, `interpolated`, `latest` or `nearest`, at the signal's capture.
            pose: `interpolated`, `latest` or `nearest`, at the signal's capture.
            taxels: `interpolated`, `latest` or `nearest`, at the signal's capture.
            align: Methods by the name of a stream; they precede those by kind.
            rate_hz: Rate of the rows; the session's if None.
            run: Run of whose clock `t_ns` is; determined from the samples if None.

        Raises:
            SessionError: An unknown stream or method, or a corrupt stream.
        """
        ticks = ticks_before(t_ns, n, rate_hz or self.rate_hz)
        found = self.run_at(t_ns) if run is None else run
        sources = sources_near(self, found, ticks) if n > 0 else self.sources(found)
        by_kind = {"camera": image, "depth": image, "force": force, "pose": pose, "taxels": taxels}
        chosen = {name: by_kind.get(self.streams[name].traits.kind) for name in sources.streams}
        methods = {name: method for name, method in chosen.items() if method is not None}
        rows = align_window(ticks, sources, {**methods, **(align or {})})
        shown = {
            name: replace(aligned, value=self._pixels(name, aligned.row))
            for name, aligned in rows.streams.items()
            if aligned.row is not None and self.streams[name].layout.image is not None
        }
        return replace(rows, streams={**rows.streams, **shown})

    def follow(
        self, *streams: str, poll: float = 0.1, timeout: float | None = None
    ) -> Iterator[StreamRow]:
        """Yield rows as they are recorded, from the first after those that `streams` shows.

        Ends when the session is closed and all rows were yielded. Rows of one stream come in order.

        Args:
            streams: Names of the streams to follow; all if none is given.
            poll: Pause before looking for further rows [s].
            timeout: Longest time without a row before the iteration ends [s]; None waits for ever.

        Raises:
            SessionError: No such stream, a remote session, or a corrupt file.
        """
        if not self.files.local:
            raise SessionError(f"{self.name}: only sessions on this machine can be followed")
        unknown = [name for name in streams if name not in self.streams]
        if unknown:
            known = ", ".join(self.order)
            raise SessionError(f"{self.name}: no stream {unknown[0]!r}; known: {known}")
        ends = {name: len(self.streams[name]) for name in streams or self.order}
        followed = {name: Stream(self.path / "streams" / name, live=True) for name in ends}
        last = time.monotonic()
        while True:
            live = read_session_attrs(self.path, LOCAL)["status"] == "recording"
            found = False
            for name, start in ends.items():
                if live:
                    followed[name].refresh()
                else:
                    followed[name] = Stream(self.path / "streams" / name)
                for row in followed[name].rows_from(start):
                    yield row
                    found = True
                ends[name] = len(followed[name])
            if not live and not found:
                return
            last = time.monotonic() if found else last
            if timeout is not None and time.monotonic() - last > timeout:
                return
            time.sleep(poll)

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
