"""Append rows to one stream. This is the hot path of every recording process."""

from __future__ import annotations

import fcntl
import os
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from recorder.errors import SessionError
from recorder.store import images
from recorder.store.column import ColumnReader
from recorder.store.durable import TEMPORARY, Background
from recorder.store.journal import (
    CRC_BYTES,
    HEADER,
    Journal,
    JournalledRows,
    pack_block,
    read_journals,
    remove_journals,
    row_time,
    write_journal,
)
from recorder.store.layout import PARTIAL, Layout, StreamLayout, decoded_rows
from recorder.store.rows import RowPacker
from recorder.store.shard import (
    ColumnLog,
    OpenShard,
    chunk_count,
    read_shard_index,
    scan_partial,
)

# State of a stream after its writer stopped, however that happened, and how to resume it.
#
# Rows below the first journal come from the shards, later rows from the journals. An image counts
# only with its row, and a row only with its image. Resuming and recovering are the same operation:
# both return the stream to the state that it had while written, after its last complete row.

# Number of full journals and shards that wait for the next flush at most.
_PENDING_MAX = 8
# Reserved space on disk for a stream being written, so that it can be closed on a full disk.
_RESERVED = "reserved"


@dataclass(frozen=True, slots=True)
class StreamState:
    """State of a stream as found by a read-only survey."""

    rows: int
    """Number of rows that are complete in every column."""
    journalled: JournalledRows | None
    """Rows not yet stored as chunks; None if the stream was closed."""
    torn_bytes: int
    """Bytes of records that were being written when the writer died."""
    dropped_rows: int
    """Number of rows that only some columns have."""
    unfinished: tuple[Path, ...]
    """Files that a closed stream does not have."""


def survey(layout: StreamLayout) -> StreamState:
    """Return the state of a stream without changing it."""
    journalled = read_journals(layout)
    if journalled is None:  # closed, or never opened: the declared lengths hold
        lengths = [column.rows() for column in layout.columns]
        return StreamState(min(lengths), None, 0, _spread(lengths), unfinished_files(layout))
    held, torn = zip(*(count_chunks(column) for column in layout.columns), strict=True)
    blocks = min(held[-len(layout.small) :])
    end = blocks * layout.block
    if journalled.first_row <= end:
        lengths = [journalled.first_row + len(journalled.rows)]
    else:  # no journal of this stream: one begins no later than the chunks end
        declared = min(column.rows() for column in layout.small)
        lengths = [declared if end - layout.block < declared <= end else end]
    if layout.image is not None:
        lengths.append(held[0])
    return StreamState(
        min(lengths),
        journalled,
        journalled.torn_bytes + sum(torn),
        _spread(lengths),
        unfinished_files(layout),
    )


def count_chunks(column: Layout) -> tuple[int, int]:
    """Return a column's number of chunks without a gap, and its torn bytes."""
    chunks = torn = 0
    numbers = column.shard_numbers()
    for number in numbers:
        if column.partial(number).exists():
            records, torn_here = scan_partial(column, number)
            held = len(records)
            torn += torn_here
        elif number < numbers[-1]:  # no shard is begun before the previous one is full
            held = column.chunks_per_shard
        else:
            held = chunk_count(read_shard_index(column, number).entries)
        if chunks == number * column.chunks_per_shard:
            chunks += held
    return chunks, torn


def unfinished_files(layout: StreamLayout) -> tuple[Path, ...]:
    """Return the files that exist only while a stream is being written."""
    return tuple(sorted(p for p in layout.path.rglob("*") if is_unfinished(layout, p)))


def is_unfinished(layout: StreamLayout, path: Path) -> bool:
    """Return True if a path below a stream exists only while the stream is being written."""
    name, parent = path.name, path.parent
    if parent == layout.time.path and (name.startswith("journal-") or name == _RESERVED):
        return True
    columns = [column.path for column in layout.columns]
    if name.endswith(TEMPORARY) and parent in (layout.path, *columns):
        return True
    return PARTIAL in name and any(column / "c" in path.parents for column in columns)


@dataclass(frozen=True, slots=True)
class OpenStream:
    """A stream open for appending."""

    image: ColumnLog | None
    """Log of the images."""
    small: tuple[ColumnLog, ...]
    """Logs of the other columns, up to the start of the journal."""
    journal: Journal
    """Journal of the rows after them."""


def restore(layout: StreamLayout) -> OpenStream:
    """Open a stream after its last complete row. If killed, it can be called again."""
    for path in unfinished_files(layout):
        if path.name.endswith(TEMPORARY) or path.name == _RESERVED:
            path.unlink()
    state = survey(layout)
    block = layout.block
    first_row, rows = _rows_to_journal(layout, state)
    start = state.rows - state.rows % block
    image = ColumnLog(layout.image, state.rows) if layout.image else None
    small = tuple(ColumnLog(column, first_row // block) for column in layout.small)
    for done in range(0, start - first_row, block):
        store_block(layout, small, first_row + done, rows[done : done + block])
    for log in small:
        log.sync()
    journal = Journal(layout, start, rows[start - first_row :])
    journal.sync()
    if state.journalled is not None:
        remove_journals(state.journalled.paths, keep=journal.path)
    for column in layout.columns:
        if column.rows() > state.rows:
            column.set_rows(state.rows)
    return OpenStream(image, small, journal)


def store_block(
    layout: StreamLayout, logs: tuple[ColumnLog, ...], first_row: int, rows: list[bytes]
) -> None:
    """Append one block of rows to all small columns, and seal full shards.

    Columns that already have the block are skipped, so the call may be repeated after an error.
    """
    number = first_row // layout.block
    for log, chunk in zip(logs, pack_block(layout, rows), strict=True):
        if log.chunks == number:
            log.append(chunk, row_time(rows[-1]))
        log.seal_full()


def _rows_to_journal(layout: StreamLayout, state: StreamState) -> tuple[int, list[bytes]]:
    """Return the rows that must (again) be in a journal, writing the journal if necessary."""
    journalled = state.journalled
    start = state.rows - state.rows % layout.block
    if journalled is not None and journalled.first_row <= state.rows:
        rows = journalled.rows[: state.rows - journalled.first_row]
        within = journalled.first_row % layout.block
        first_row = journalled.first_row - within
        if within:  # of a file that no writer made; the block before its rows is stored
            rows = [*_stored_rows(layout, first_row, journalled.first_row), *rows]
        if within or layout.journal(start) not in journalled.paths:
            write_journal(layout, start, rows[start - first_row :])
        return first_row, rows
    rows = _stored_rows(layout, start, state.rows)
    write_journal(layout, start, rows)
    return start, rows


def _stored_rows(layout: StreamLayout, start: int, stop: int) -> list[bytes]:
    """Return the rows of the last, incomplete block, packed as in a journal."""
    if start == stop:
        return []
    table = np.zeros(stop - start, layout.row_dtype)
    for column in layout.small:
        table[column.column.name] = _read_chunk(column, start // layout.block)[: stop - start]
    return [row.tobytes() for row in table]


def _spread(lengths: list[int]) -> int:
    return max(lengths) - min(lengths)


def _read_chunk(column: Layout, chunk: int) -> NDArray[Any]:
    number, place = divmod(chunk, column.chunks_per_shard)
    path = column.partial(number)
    if not path.exists():
        return decoded_rows(column, ColumnReader(column).chunk(chunk))
    record = scan_partial(column, number)[0][place]  # its checksum matched
    with path.open("rb") as file:
        file.seek(record.offset)
        data = file.read(record.nbytes - CRC_BYTES)
    return decoded_rows(column, data)


_RESERVED_BYTES = 1 << 16  # indices and metadata of a dozen columns, in full disk blocks


class StreamWriter:
    """The only writer of a stream.

    A row is accepted when `append` returns: from then on it survives the death of this process, and
    at most `sync_interval` seconds later also that of the machine. Images go directly into the open
    shard, the other columns into the row journal, which commits the row. Sealing, encoding and
    flushing run in a background thread.
    """

    def __init__(self, layout: StreamLayout, lock: int, sync_interval: float) -> None:
        """Use `open` instead."""
        self._layout = layout
        self._lock = lock
        self._closed = False
        stream = restore(layout)
        self._image = stream.image
        self._small = stream.small
        self._journal = stream.journal
        self._pack = RowPacker(layout).pack
        self._time = layout.time.column.name
        if layout.image is not None:
            image = layout.image.column
            self._image_name = image.name
            self._encode = images.encoder(image, f"{layout.name}.{image.name}")
        self.rows: int = self._journal.first_row + len(self._journal.rows)
        """Number of rows accepted so far."""
        _reserve(layout)
        layout.set_attrs(sync_interval=sync_interval)
        # Handed over to the background thread: shards with the journal of their last image.
        self._full_shards: deque[tuple[OpenShard, Journal]] = deque()
        self._full_journals: deque[Journal] = deque()
        self._spares: deque[Journal] = deque()
        self._background = Background(
            self._flush, interval=sync_interval, name=f"recorder-{layout.name}"
        )

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns that `append` takes."""
        return tuple(layout.column.name for layout in self._layout.columns)

    @classmethod
    def open(cls, path: str | os.PathLike[str], *, sync_interval: float = 1.0) -> Self:
        """Open a stream for writing after its last complete row, however its last writer ended.

        Args:
            path: The stream's group, e.g. `<session>/streams/force`.
            sync_interval: Longest time between two flushes to the disk [s].

        Raises:
            SessionError: Not a stream, corrupt, or open in another writer.
        """
        layout = StreamLayout.load(Path(path))
        lock = lock_stream(layout)
        try:
            return cls(layout, lock, sync_interval)
        except BaseException:
            os.close(lock)
            raise

    def append(self, **columns: Any) -> int:
        """Append one row and return its number.

        An image is JPEG bytes or pixels, as its column declares; any other column is a number or an
        array of the declared shape. Float columns accept integers; only they accept NaN.

        Raises:
            SessionError: A missing, unknown or ill-typed column, a closed writer, or damage that
                keeps earlier rows from being sealed. The row is not stored; earlier rows are.
            OSError: The disk is full or failing. The row is not stored; earlier rows are.
        """
        if self._closed:
            raise SessionError(f"{self._layout.name}: the writer is closed")
        if self._background.failure is not None:
            failure = self._background.failure
            if isinstance(failure, OSError):
                raise OSError(failure.errno, failure.strerror, failure.filename) from failure
            raise SessionError(
                f"{self._layout.name}: recording stopped, rows could not be sealed: "
                f"{type(failure).__name__}: {failure}"
            ) from failure
        if self._journal.full:  # the next one could not be created
            self._hand_over()
        row = self._pack(columns)
        t_ns = int(columns[self._time])
        if self._image is None:
            self._journal.append(row, t_ns)
        else:
            self._image.append(self._encode(columns[self._image_name]), t_ns)
            try:
                self._journal.append(row, t_ns)
            except OSError:
                self._image.drop_last()
                raise
        number = self.rows
        self.rows = number + 1
        if self._journal.full or (self._image is not None and self._image.full):
            with suppress(OSError):  # this row is stored; the next append tries again
                self._hand_over()
        return number

    def set_attrs(self, **attrs: Any) -> None:
        """Merge into the stream's attributes, atomically.

        Raises:
            SessionError: A value that JSON cannot hold.
        """
        self._layout.set_attrs(**attrs)

    def close(self) -> None:
        """Seal all appended rows, so that every Zarr reader sees them. May be called twice.

        Raises:
            OSError: No space left even for that; all rows are kept for `recover`.
        """
        if self._closed:
            return
        self._closed = True
        try:
            self._background.stop()
            (self._layout.time.path / _RESERVED).unlink(missing_ok=True)
            self._background.drain()
            self._settle()
            for spare in self._spares:
                spare.remove()
            self._seal()
        finally:
            for log in (*self._small, *([self._image] if self._image else [])):
                log.close()
            for journal in (self._journal, *self._spares):
                journal.close()
            os.close(self._lock)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _hand_over(self) -> None:
        """Pass full shards and journals to the background thread and start new ones.

        Both are passed on only after the row was committed, so no shard is ever sealed with an
        image that has no row.
        """
        shard = None if self._image is None else self._image.take_full()
        if shard is not None:
            self._full_shards.append((shard, self._journal))
        full = self._journal.full
        if full:
            if self._spares:
                self._spares[0].restart(self.rows)
                following = self._spares.popleft()
            else:
                following = Journal(self._layout, self.rows, [])
            self._full_journals.append(self._journal)
            self._journal = following
        # The next flush stores and seals them; before that only if there are many.
        if len(self._full_journals) + len(self._full_shards) >= _PENDING_MAX:
            self._background.submit(self._settle)

    def _settle(self) -> None:
        """Store all full journals and seal all full shards, with few flushes for all of them.

        May be repeated after an error: nothing leaves its queue before it is done.
        """
        # In this order: the rows of a shard are in the first list, or in journals that follow it.
        journals, shards = list(self._full_journals), list(self._full_shards)
        for journal in journals:
            store_block(self._layout, self._small, journal.first_row, journal.rows)
        for log in self._small if journals else ():
            log.sync()
        if self._image is not None and shards:
            # No shard may be sealed before the rows of its images are durable.
            rows = [*list(self._full_journals)[len(journals) :], *(rows for _, rows in shards)]
            for journal in rows:
                if journal not in journals:
                    journal.sync()
            self._image.seal([shard for shard, _ in shards])
            for _ in shards:
                self._full_shards.popleft()
        for journal in journals:
            if len(self._spares) < _PENDING_MAX:
                journal.retire()
                self._spares.append(journal)
            else:
                journal.remove()
            self._full_journals.popleft()

    def _flush(self) -> None:
        self._settle()
        self._sync()

    def _sync(self) -> None:
        # Images first: after a power failure, a row without its image does not count.
        if self._image is not None:
            self._image.sync()
        for log in self._small:
            log.sync()
        self._journal.sync()

    def _seal(self) -> None:
        self._sync()  # until all columns are sealed, recovery depends on the journal
        if self._journal.rows:
            store_block(self._layout, self._small, self._journal.first_row, self._journal.rows)
        for log in (*([self._image] if self._image else []), *self._small):
            log.finish(self.rows)
        self._journal.remove()


def lock_stream(layout: StreamLayout) -> int:
    """Lock the stream for this process until the returned file descriptor is closed."""
    fd = os.open(layout.time.path, os.O_RDONLY)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(fd)
        raise SessionError(f"{layout.path}: is being written by another process") from None
    return fd


def _reserve(layout: StreamLayout) -> None:
    """Reserve the space that sealing will need; a full disk has none to reserve."""
    room = _RESERVED_BYTES + layout.block * (layout.row_dtype.itemsize + HEADER.size)
    path = layout.time.path / _RESERVED
    try:
        path.write_bytes(bytes(room))
    except OSError:
        path.unlink(missing_ok=True)
