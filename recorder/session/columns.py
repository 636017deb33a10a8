"""Columns of one stream, as recorded. Takes no lock, changes nothing and never fills in values.

A chunk that is declared but missing is an error here; a plain Zarr reader returns fill values.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from recorder.errors import SessionError
from recorder.spec import Column, Traits
from recorder.store import images
from recorder.store.files import LOCAL, Files
from recorder.store.layout import StreamLayout
from recorder.store.reader import ColumnReader, Kept, LiveRows, LiveStream

Array = np.ndarray[Any, Any]


class Stream:
    """One stream of a session: columns of equal length, as recorded."""

    def __init__(self, path: Path, files: Files = LOCAL, *, live: bool = False) -> None:
        """Open a stream; use `Session.streams` instead.

        `live` includes the rows that are not sealed yet, up to this moment.
        """
        self.layout = StreamLayout.load(path, files)
        self.name = path.name
        self.attrs = self.layout.attrs()
        self.traits = Traits.read(self.name, self.attrs)
        self._live: LiveRows | None = None
        self._tail = LiveStream(self.layout) if live else None
        self._readers: Mapping[str, ColumnReader] = (
            {layout.column.name: ColumnReader(layout) for layout in self.layout.columns}
            if self._tail is None
            else self._tail.readers
        )
        self._rows = min(reader.rows for reader in self._readers.values())
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
        for name, reader in self._readers.items():
            reader.rows = self._live.stored if name in self.small else self._rows

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
        columns = (layout.column for layout in self.layout.columns)
        return next((column for column in columns if column.name == "value"), None)

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
        column = self._columns.get(name)
        if column is None:
            column = self._columns.put(name, self.rows_between(name, 0, self._rows))
        return column

    def rows_between(self, name: str, start: int, stop: int) -> Array:
        """Return rows [start, stop) (n, ...) of a small column, reading only their chunks.

        Raises:
            SessionError: No such column, an image column, or a corrupt chunk.
        """
        rows = self._reader(name).rows_between(start, min(stop, self._rows))
        if self._live is None or stop <= self._live.stored:
            return rows
        stored = self._live.stored
        rest = self._live.journalled[name][max(start - stored, 0) : max(stop - stored, 0)]
        return np.concatenate([rows, rest])

    def rows(self, name: str, rows: slice) -> Rows:
        """Return some rows of a small column (n, ...), which are read when they are sliced."""
        return Rows(self, name, *rows.indices(self._rows)[:2])

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
        column = self._image()[0]
        numbers = np.arange(self._rows)[rows] if isinstance(rows, slice) else np.asarray(rows)
        if len(numbers):
            self._checked(int(numbers.min()))
        out = np.empty((len(numbers), *column.shape), column.dtype)
        self.images_into(numbers, out)
        return out

    def images_into(self, rows: NDArray[np.integer[Any]], out: Array) -> None:
        """Decode images of rows (n,) into an array (n, h, w, channels), which may be used again.

        It is C-contiguous, of the type that `images` returns; row -1 leaves the image in its place
        as it is.

        Raises:
            SessionError: No images here, a row outside the stream, or a corrupt image.
        """
        column, reader = self._image()
        expected = (len(rows), *column.shape)
        if out.shape != expected or out.dtype != column.dtype or not out.flags.c_contiguous:
            raise SessionError(
                f"{self.name}: found out {out.dtype} {out.shape}, expected {column.dtype} "
                f"{expected}, contiguous"
            )
        if len(rows):
            self._checked(max(int(np.max(rows)), 0))
        reader.read_images(np.asarray(rows).tolist(), out)

    def jpeg(self, row: int) -> bytes | None:
        """Return the camera's original bytes of one image, or None if it was stored losslessly.

        Raises:
            SessionError: No images here, or a row outside the stream.
        """
        column, reader = self._image()
        return reader.chunk(self._checked(row)) if column.codec == "jpeg" else None

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
        column, reader = self._image()
        if column.codec != "jpeg":
            raise SessionError(f"{self.name}: images are stored as pixels, without JPEG bytes")
        return reader.chunks([self._checked(int(row)) for row in rows])

    def _reader(self, name: str) -> ColumnReader:
        if name not in self._readers:
            raise SessionError(f"{self.name}: no column {name!r}; known: {', '.join(self.names)}")
        if name not in self.small:
            raise SessionError(f"{self.name}.{name}: use images(rows) for images")
        return self._readers[name]

    def _image(self) -> tuple[Column, ColumnReader]:
        if self.layout.image is None:
            raise SessionError(f"{self.name}: has no images; columns: {', '.join(self.names)}")
        column = self.layout.image.column
        return column, self._readers[column.name]

    def _checked(self, row: int) -> int:
        if not 0 <= row < self._rows:
            raise SessionError(f"{self.name}: no row {row}, the stream has {self._rows}")
        return row


# Rows that are looked at at once.
BLOCK = 3 << 17
# Largest column that is read as a whole for some of its rows [bytes].
_WHOLE = 1 << 24


def blocks(count: int) -> Iterator[slice]:
    """Yield the slices of `count` rows that are looked at at once."""
    return (slice(first, min(first + BLOCK, count)) for first in range(0, count, BLOCK))


class Rows:
    """Rows [first, last) of a small column, of which only what is sliced is read.

    A column that is small is read as a whole, and kept as by `Stream.array`.
    """

    def __init__(self, stream: Stream, name: str, first: int, last: int) -> None:
        """Read nothing yet."""
        self._stream, self._name, self._first, self._count = stream, name, first, last - first

    def __len__(self) -> int:
        """Return the number of rows."""
        return max(self._count, 0)

    def __getitem__(self, rows: slice | int) -> Any:
        """Return a slice (m, ...), or one row."""
        if not isinstance(rows, slice):
            return self[rows : rows + 1 or None][0]
        first, last = (self._first + end for end in rows.indices(len(self))[:2])
        layout = self._stream._reader(self._name).layout
        if len(self._stream) * layout.chunk_bytes <= layout.rows_per_chunk * _WHOLE:
            return self._stream.array(self._name)[first:last]
        return self._stream.rows_between(self._name, first, last)


class StreamTable(Mapping[str, Array]):
    """Columns of a stream that has no device: the `segments` and the `reference` of a session."""

    def __init__(self, stream: Stream) -> None:
        """Provide the columns of a stream."""
        self._stream = stream

    def __getitem__(self, name: str) -> Array:
        """Return a column (n, ...)."""
        stream = self._stream
        if name not in stream.names:
            names = ", ".join(stream.names)
            raise KeyError(f"{stream.layout.path}: no column {name!r}; known: {names}")
        return stream.array(name)

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names."""
        return iter(self._stream.names)

    def __len__(self) -> int:
        """Return the number of columns."""
        return len(self._stream.names)


class StreamPart:
    """Some rows of a stream, read without the others."""

    def __init__(self, stream: Stream, first: int, last: int) -> None:
        """Read nothing yet of rows [first, last)."""
        self.name, self.attrs, self.traits = stream.name, stream.attrs, stream.traits
        self.names = stream.names
        self.rate_hz = stream.rate_hz
        self.value_column: Column | None = stream.value_column
        self._stream, self._first, self._last = stream, first, last

    def __len__(self) -> int:
        """Return the number of rows."""
        return self._last - self._first

    @cached_property
    def t_ns(self) -> NDArray[np.int64]:
        """Arrival times (n,) [ns]."""
        return self.array(self._stream.layout.time.column.name)

    def array(self, name: str) -> Array:
        """Return a small column (n, ...)."""
        return self._stream.rows_between(name, self._first, self._last)


# What alignment and the search for losses read: a stream, or some of its rows.
Columns: TypeAlias = Stream | StreamPart


class Arrivals:
    """Arrival times of one run's rows, searched by chunk and read one chunk at a time."""

    def __init__(self, stream: Stream, first: int, last: int) -> None:
        """Search rows [first, last) of a stream."""
        self._stream = stream
        self.first, self.last = first, last
        self._known: list[tuple[int, int]] = []
        self.ordered = True

    def chunk(self, t_ns: int) -> int:
        """Return the number of the chunk that begins at or before a time, or the run's first."""
        block = self._stream.layout.block
        chunks = range(self.first // block, -(-self.last // block))
        return chunks[max(bisect_right(chunks, t_ns, key=self._start) - 1, 0)]

    def _start(self, chunk: int) -> int:
        row = max(chunk * self._stream.layout.block, self.first)
        index = bisect_right(self._known, (row, -1))
        if index < len(self._known) and self._known[index][0] == row:
            return self._known[index][1]
        time = int(self._stream.rows_between(self._stream.layout.time.column.name, row, row + 1)[0])
        before = self._known[index - 1][1] if index else time
        after = self._known[index][1] if index < len(self._known) else time
        self.ordered &= before <= time <= after
        insort(self._known, (row, time))
        return time
