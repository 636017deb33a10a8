"""Append rows to one stream. This is the hot path of every recording process."""

import fcntl
import os
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from recorder.errors import SessionError
from recorder.store import images
from recorder.store.files import TEMPORARY
from recorder.store.journal import Journal, JournalReader, row_time, write_journal
from recorder.store.layout import ColumnLayout, StreamLayout
from recorder.store.manifest import stream_groups
from recorder.store.reader import GrowingReader
from recorder.store.records import HEADER
from recorder.store.shard import ColumnLog, OpenShard, scan_partial

# State of a stream after its writer stopped, however that happened, and how to resume it.
#
# Rows below the first journal come from the shards, later rows from the journals. An image counts
# only with its row, and a row only with its image. Resuming and recovering are the same operation:
# both return the stream to the state that it had while written, after its last complete row.

# Number of full journals and shards that wait for the next flush at most.
_PENDING_MAX = 8


@dataclass(frozen=True, slots=True)
class StreamState:
    """State of a stream as found by a read-only survey."""

    rows: int
    """Number of rows that are complete in every column."""
    journalled: JournalReader | None
    """Rows not yet stored as chunks; None if the stream was closed."""
    torn_bytes: int
    """Bytes of records that were being written when the writer died."""
    dropped_rows: int
    """Number of rows that only some columns have."""
    unfinished: tuple[Path, ...]
    """Files that a closed stream does not have."""


def survey(layout: StreamLayout) -> StreamState:
    """Return the state of a stream without changing it."""
    journals = layout.journals()
    unfinished = unfinished_files(layout)
    declared = [column.rows() for column in layout.columns]
    if not journals:  # closed, or never opened: the declared lengths hold
        return StreamState(min(declared), None, 0, _spread(declared), unfinished)
    journal = JournalReader(layout)
    journal.update(journals, torn=True)
    held = [GrowingReader(column).update() for column in layout.columns]
    torn = journal.torn_bytes + sum(map(_torn_bytes, layout.columns))
    end = min(held[-len(layout.small) :]) * layout.block
    if journal.first_row <= end:
        lengths = [journal.first_row + len(journal.rows)]
    else:  # no journal of this stream: one begins no later than the chunks end
        short = min(declared[-len(layout.small) :])
        lengths = [short if end - layout.block < short <= end else end]
    if layout.image is not None:
        lengths.append(held[0])
    return StreamState(min(lengths), journal, torn, _spread(lengths), unfinished)


def _torn_bytes(column: ColumnLayout) -> int:
    """Return the bytes of the growing shards of a column that belong to no complete record."""
    growing = [number for number in column.shard_numbers() if column.partial(number).exists()]
    return sum(scan_partial(column, number)[1] for number in growing)


def unfinished_files(layout: StreamLayout) -> tuple[Path, ...]:
    """Return the files that exist only while a stream is being written."""
    return tuple(sorted(p for p in layout.path.rglob("*") if layout.is_unfinished(p)))


def restore(layout: StreamLayout) -> tuple[ColumnLog | None, tuple[ColumnLog, ...], Journal]:
    """Open a stream after its last complete row. If killed, it can be called again.

    It returns the log of the images, those of the other columns up to the start of the journal, and
    the journal of the rows after them.
    """
    for path in unfinished_files(layout):
        if path.name.endswith(TEMPORARY) or path == layout.reserved:
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
        # In order of their rows: after a crash the remaining journals are still without a gap, and
        # start no later than the end of the chunks.
        for path in state.journalled.paths:
            if path != journal.path:
                path.unlink(missing_ok=True)
    for column in layout.columns:
        if column.rows() > state.rows:
            column.set_rows(state.rows)
    return image, small, journal


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
        reader = GrowingReader(column)
        reader.update()
        chunk = column.decoded(reader.chunk(start // layout.block))
        table[column.column.name] = chunk[: stop - start]
    return [row.tobytes() for row in table]


def pack_block(layout: StreamLayout, rows: list[bytes]) -> list[bytes]:
    """Return one encoded chunk per small column; a short block is padded with fill values."""
    table = np.frombuffer(b"".join(rows), layout.row_dtype)
    chunks = []
    for column in layout.small:
        missing = np.nan if column.dtype.kind == "f" else 0
        chunk = np.full(column.chunk_shape, missing, column.dtype)
        chunk[: len(rows)] = table[column.column.name]
        chunks.append(images.compress(chunk.data.cast("B")))
    return chunks


def _spread(lengths: list[int]) -> int:
    return max(lengths) - min(lengths)


# Packing of a row into the bytes of its journal record, with validation.

_STRUCT_CODES = {
    "uint8": "<B",
    "uint16": "<H",
    "int8": "<b",
    "int16": "<h",
    "int32": "<i",
    "int64": "<q",
    "float32": "<f",
    "float64": "<d",
}

Packer = Callable[[Any], bytes]


def row_packer(layout: StreamLayout) -> Callable[[Mapping[str, Any]], bytes]:
    """Return the function that packs the small columns of one row, in the stream's order."""
    names = tuple(column.column.name for column in layout.columns)
    packers = tuple(
        (column.column.name, packer(column, f"{layout.name}.{column.column.name}"))
        for column in layout.small
        for packer in (_array_packer if column.column.shape else _scalar_packer,)
    )

    def pack_row(columns: Mapping[str, Any]) -> bytes:
        try:
            if len(columns) == len(names) and names[0] in columns:
                return b"".join([pack(columns[name]) for name, pack in packers])
        except KeyError:
            pass
        wrong = f"found columns {', '.join(columns)}; expected {', '.join(names)}"
        raise SessionError(f"{layout.name}: {wrong}")

    return pack_row


def _scalar_packer(layout: ColumnLayout, where: str) -> Packer:
    dtype = layout.column.dtype
    pack = struct.Struct(_STRUCT_CODES[dtype]).pack
    exact, kinds = (float, (int, float)) if dtype.startswith("float") else (int, (int,))
    numpy_kinds = (np.integer, np.floating) if exact is float else (np.integer,)

    def pack_scalar(value: Any) -> bytes:
        if type(value) is not exact:
            if isinstance(value, np.ndarray) and value.shape == ():
                value = value[()]
            if isinstance(value, bool) or not isinstance(value, (*kinds, *numpy_kinds)):
                raise SessionError(f"{where}: found {_describe(value)}, expected {dtype}")
        try:
            return pack(value)
        except (struct.error, OverflowError):
            raise SessionError(f"{where}: found {value}, out of range for {dtype}") from None

    return pack_scalar


def _array_packer(layout: ColumnLayout, where: str) -> Packer:
    dtype, shape = layout.dtype, layout.column.shape
    expected = f"{layout.column.dtype} {shape}"

    def pack_array(value: Any) -> bytes:
        if type(value) is np.ndarray and value.dtype == dtype and value.shape == shape:
            return value.tobytes()
        try:
            array = np.asarray(value)
        except ValueError:
            raise SessionError(f"{where}: found a ragged list, expected {expected}") from None
        if array.shape != shape or not _fits(array, dtype):
            raise SessionError(f"{where}: found {_describe(array)}, expected {expected}")
        return array.astype(dtype).tobytes()

    return pack_array


def _fits(array: np.ndarray[Any, Any], dtype: np.dtype[Any]) -> bool:
    """Return True if every value survives the conversion, up to floating-point rounding."""
    if array.dtype.kind not in ("iuf" if dtype.kind == "f" else "iu"):
        return False
    if dtype.kind == "f" or not array.size:
        return True
    limits = np.iinfo(dtype)
    return bool(limits.min <= int(array.min()) and int(array.max()) <= limits.max)


def _describe(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape}"
    return f"{type(value).__name__} {value!r:.40}"


# One thread for all slow work: sealing, encoding blocks, flushing to disk.


class Background:
    """Thread that runs jobs in order, and a flush every `interval` seconds.

    A job that fails, for whatever reason, remains first in the queue, with its error in `failure`;
    no other job runs until `drain`. The thread never ends with jobs undone and no `failure`.
    """

    def __init__(self, flush: Callable[[], None], *, interval: float, name: str) -> None:
        self.failure: BaseException | None = None
        self._flush = flush
        self._interval = interval
        self._jobs: deque[Callable[[], None]] = deque()
        self._wake = threading.Event()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def submit(self, job: Callable[[], None]) -> None:
        """Queue a job. A job that fails must be safe to run again."""
        self._jobs.append(job)
        self._wake.set()

    def stop(self) -> None:
        """End the thread once all queued jobs are done or one failed. May be called twice."""
        self._stopping = True
        self._wake.set()
        self._thread.join()

    def drain(self) -> None:
        """Run the remaining jobs in the calling thread, after `stop`."""
        while self._jobs:
            self._jobs[0]()
            self._jobs.popleft()
        self.failure = None

    def _run(self) -> None:
        due = time.monotonic() + self._interval
        while not self._stopping:
            self._wake.wait(max(due - time.monotonic(), 0.0))
            self._wake.clear()
            try:
                while self._jobs and self.failure is None:
                    self._jobs[0]()
                    self._jobs.popleft()
                if time.monotonic() >= due:
                    due = time.monotonic() + self._interval
                    if self.failure is None:
                        self._flush()
            except BaseException as error:  # the thread that appends must learn of any error
                self.failure = error


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
        self._image, self._small, self._journal = restore(layout)
        self._pack = row_packer(layout)
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

        Its group is such as `<session>/streams/force`; it is flushed to the disk after
        `sync_interval` [s] at most.

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
            self._layout.reserved.unlink(missing_ok=True)
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
        if self._journal.full:
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
    except OSError as error:
        os.close(fd)
        raise SessionError(
            f"{layout.path}: its file system has no locks ({error.strerror}); record on a local "
            "disk (--out), or mount this one with locks (NFS: lockd, nolock off)"
        ) from None
    return fd


def _reserve(layout: StreamLayout) -> None:
    """Reserve the space that sealing will need; a full disk has none to reserve."""
    room = _RESERVED_BYTES + layout.block * (layout.row_dtype.itemsize + HEADER.size)
    try:
        layout.reserved.write_bytes(bytes(room))
    except OSError:
        layout.reserved.unlink(missing_ok=True)


# Recovery after the writers were killed or the power failed.


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
    return [_recover(path, group) for group in stream_groups(path)]


def _recover(session: Path, group: Path) -> StreamRecovery:
    layout = StreamLayout.load(group)
    state = survey(layout)
    stored_rows = min(column.rows() for column in layout.columns)
    touched = bool(state.unfinished or state.dropped_rows)
    if touched:
        StreamWriter.open(group).close()
    return StreamRecovery(
        str(group.relative_to(session)),
        state.rows,
        state.rows - min(stored_rows, state.rows),
        state.torn_bytes,
        state.dropped_rows,
        touched,
    )
