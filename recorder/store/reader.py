"""Read the rows of arrays directly from their files, local or remote.

The checksum of every chunk is verified. A chunk that is declared but missing is an error here; a
plain Zarr reader returns fill values. `GrowingReader` reads an array while it is being written,
`LiveStream` all of a stream, `Table` the columns of a group.
"""

import multiprocessing
import os
import threading
from collections import OrderedDict
from collections.abc import Hashable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar
from weakref import WeakValueDictionary

import google_crc32c
import numpy as np

from recorder.errors import SessionError
from recorder.store import images
from recorder.store.documents import read_document
from recorder.store.files import LOCAL, Files
from recorder.store.journal import GrowingLog, JournalReader
from recorder.store.layout import (
    MISSING,
    Array,
    ArrayLayout,
    ColumnLayout,
    ShardIndex,
    StreamLayout,
    TableColumn,
    table_columns,
)
from recorder.store.records import CRC_BYTES

# Memory for what was read last, shared by all readers of a process and limited in bytes.
#
# A reader finds what it read through a weak reference; only `RECENT` keeps it alive. So the memory
# of a program does not grow with the sessions that it opens.


class _Sized(Protocol):
    @property
    def nbytes(self) -> int: ...


T = TypeVar("T", bound=_Sized)

# Largest size of everything kept [bytes].
LIMIT = 64 << 20
# Memory that the interpreter needs for one object that is kept: header, entries, reference [bytes].
_OBJECT_BYTES = 600


class Recent:
    """The objects used last, up to a total size."""

    def __init__(self, limit: int) -> None:
        """Keep up to `limit` bytes."""
        self.limit = limit
        self.nbytes = 0
        self._kept: OrderedDict[int, tuple[Any, int]] = OrderedDict()
        self._lock = threading.Lock()

    def keep(self, value: Any, nbytes: int) -> None:
        """Keep an object as the last used, up to the limit; the longest unused are released."""
        if nbytes > self.limit:
            return
        key = id(value)  # unique as long as the object is kept
        with self._lock:
            previous = self._kept.pop(key, None)
            self._kept[key] = (value, nbytes)
            self.nbytes += nbytes - (previous[1] if previous else 0)
            while self.nbytes > self.limit:
                _, (_, released) = self._kept.popitem(last=False)
                self.nbytes -= released

    def clear(self) -> None:
        """Release everything; also in a forked process, where the lock may be held for ever."""
        self._lock = threading.Lock()
        self._kept.clear()
        self.nbytes = 0


RECENT = Recent(LIMIT)
os.register_at_fork(after_in_child=RECENT.clear)


class Kept(Generic[T]):
    """Values that one reader has read, as long as they are in memory. Pickled and copied empty."""

    def __init__(self) -> None:
        self._found: WeakValueDictionary[Hashable, T] = WeakValueDictionary()

    def get(self, key: Hashable) -> T | None:
        """Return the value of a key, or None if it has to be read again."""
        value = self._found.get(key)
        return None if value is None else self.put(key, value)

    def put(self, key: Hashable, value: T) -> T:
        """Remember a value that has `nbytes` and supports weak references, and return it."""
        self._found[key] = value
        RECENT.keep(value, _OBJECT_BYTES + value.nbytes)
        return value

    def __reduce__(self) -> tuple[Any, ...]:
        return (Kept, ())


# Chunks and rows of one array.

# Chunks fetched concurrently from a remote store: hides latency and limits memory.
_BATCH = 16
# Least number of JPEGs for which a thread is worth its start.
_JPEGS_PER_THREAD = 4


class ColumnReader:
    """Reader of one array.

    It holds no file open and no data of its own, so that it can be forked, pickled and copied, and
    thousands of readers cost little: what was read last is kept by `RECENT`, within a limit that
    all readers of the process share.
    """

    def __init__(self, layout: ArrayLayout) -> None:
        """Read the declared length; shards are opened only when needed."""
        self.layout = layout
        self.rows = layout.rows()
        self._local = layout.files.local
        self._indices: Kept[ShardIndex] = Kept()
        self._decoded: Kept[Array] = Kept()

    def __len__(self) -> int:
        """Return the number of rows."""
        return self.rows

    def chunk(self, number: int) -> bytes:
        """Return an encoded chunk, without its checksum."""
        return next(self.chunks([number]))

    def chunks(self, numbers: Sequence[int]) -> Iterator[bytes]:
        """Yield encoded chunks; from a remote store several are fetched concurrently."""
        for data in self._verified_chunks(numbers):
            yield bytes(data)

    def read_images(self, rows: Sequence[int], out: Array) -> None:
        """Decode the images of rows into `out` (n, h, w, channels), contiguous, each of them once.

        It has the column's shape and little-endian type; nothing is written for a row below 0.
        JPEGs are decoded on several cores, except in a worker process of `multiprocessing`, which
        shares them with others.
        """
        decode = images.decoder_into(self.layout.codec, self.layout.chunk_bytes)
        first = {row: index for index, row in reversed(list(enumerate(rows))) if row >= 0}
        wanted = sorted(first)

        def read(some: list[int]) -> None:
            for row, data in zip(some, self._verified_chunks(some), strict=True):
                try:
                    decode(data, out[first[row]])
                except SessionError as error:
                    raise SessionError(f"{self._chunk_name(row)}: {error}") from error

        threads = self._threads(len(wanted))
        if threads < 2:
            read(wanted)
        else:
            each = -(-len(wanted) // threads)
            own, *others = (wanted[i : i + each] for i in range(0, len(wanted), each))
            with ThreadPoolExecutor(threads - 1) as pool:
                rest = pool.map(read, others)
                read(own)
                list(rest)
        for index, row in enumerate(rows):
            if row >= 0 and first[row] != index:
                out[index] = out[first[row]]

    def _threads(self, count: int) -> int:
        """Return the number of threads for `count` images."""
        worker = multiprocessing.parent_process() is not None
        if worker or not self._local or self.layout.codec != "jpeg":
            return 1
        return min(os.cpu_count() or 1, count // _JPEGS_PER_THREAD)

    def rows_between(self, start: int, stop: int) -> Array:
        """Return rows [start, stop) (n, ...) of numbers, reading only their chunks."""
        step, per_shard = self.layout.rows_per_chunk, self.layout.chunks_per_shard
        stop = min(stop, self.rows)
        numbers = range(start // step, -(-stop // step)) if stop > start else range(0)
        for number in numbers[::per_shard]:  # the shards exist before memory is allocated
            self._shard_index(number // per_shard)
        out = np.empty((max(stop - start, 0), *self.layout.shape[1:]), self.layout.dtype)
        for number, rows in self._decoded_chunks(numbers):
            low, high = max(start, number * step), min(stop, (number + 1) * step)
            out[low - start : high - start] = rows[low - number * step : high - number * step]
        return out

    def read(self) -> Array:
        """Return all rows (n, ...) of numbers."""
        return self.rows_between(0, self.rows)

    def gathered(self, numbers: Array) -> Array:
        """Return the rows with the given numbers (n, ...), reading only their chunks."""
        chunk, within = np.divmod(numbers, self.layout.rows_per_chunk)
        out = np.empty((len(numbers), *self.layout.shape[1:]), self.layout.dtype)
        order = np.argsort(chunk, kind="stable")
        wanted, first = np.unique(chunk[order], return_index=True)
        positions = np.split(order, first[1:])
        for (_, rows), here in zip(self._decoded_chunks(wanted.tolist()), positions, strict=False):
            out[here] = rows[within[here]]
        return out

    def _decoded_chunks(self, numbers: Sequence[int]) -> Iterator[tuple[int, Array]]:
        """Yield chunks of a small column with their rows, in order; fill values included."""
        many = len(numbers) * self.layout.chunk_bytes > RECENT.limit // 64
        cached = {} if many else {number: self._decoded.get(number) for number in numbers}
        missing = [number for number in numbers if cached.get(number) is None]
        fetched = self._verified_chunks(missing)
        for number in numbers:
            rows = cached.get(number)
            if rows is None:
                rows = self.layout.decoded(next(fetched))
                if not many:  # a whole column would only push everything else out
                    self._decoded.put(number, rows)
            yield number, rows

    def _verified_chunks(self, numbers: Sequence[int]) -> Iterator[Any]:
        """Yield encoded chunks whose checksum matches; each is valid until the next."""
        per_shard = self.layout.chunks_per_shard
        for first in range(0, len(numbers), _BATCH):
            batch = numbers[first : first + _BATCH]
            for shard, of_shard in groupby(batch, per_shard.__rfloordiv__):
                read = self._read if self._local else self._fetched
                yield from read(shard, list(of_shard))

    def _read(self, shard: int, numbers: list[int]) -> Iterator[Any]:
        """Read chunks of one local shard into one buffer, one after the other."""
        index = self._shard_index(shard)
        wanted = [self._range(index, number) for number in numbers]
        fd = os.open(self._path(shard), os.O_RDONLY)
        try:
            size = os.fstat(fd).st_size  # of a range beyond it nothing is allocated
            length = min(max(nbytes for _, nbytes in wanted), size)
            buffer: Any = np.empty(length, np.uint8)
            for number, (offset, nbytes) in zip(numbers, wanted, strict=True):
                read_size = os.preadv(fd, [buffer[:nbytes]], offset) if offset < size else 0
                yield self._verified(index, buffer[:read_size], nbytes, number)
        finally:
            os.close(fd)

    def _path(self, shard: int) -> Path:
        """Return the file that the chunks of a shard are read from."""
        return self.layout.shard(shard)

    def _fetched(self, shard: int, numbers: list[int]) -> Iterator[Any]:
        index, files, path = self._shard_index(shard), self.layout.files, self.layout.shard(shard)
        wanted = [self._range(index, number) for number in numbers]
        fetched = files.ranges(path, wanted)
        for number, (_, nbytes), data in zip(numbers, wanted, fetched, strict=True):
            yield self._verified(index, data, nbytes, number)

    def _range(self, index: ShardIndex, number: int) -> tuple[int, int]:
        """Return the offset and the length of a chunk."""
        offset, nbytes = index.ranges[number % self.layout.chunks_per_shard]
        if offset == MISSING:
            raise SessionError(f"{self._chunk_name(number)} is missing")
        return offset, nbytes

    def _shard_index(self, shard: int) -> ShardIndex:
        index = self._indices.get(shard)
        return self._indices.put(shard, self.layout.index(shard)) if index is None else index

    def _verified(self, index: ShardIndex, data: Any, nbytes: int, number: int) -> Any:
        if len(data) != nbytes:
            fault = "is cut short"
        else:
            chunk, end = data[:-CRC_BYTES], int.from_bytes(data[-CRC_BYTES:], "little")
            listed = index.crcs[number % self.layout.chunks_per_shard] if index.crcs else end
            if google_crc32c.value(chunk) == listed == end:
                return chunk
            fault = "does not match its checksum"
        raise SessionError(f"{self._chunk_name(number)} {fault}")

    def _chunk_name(self, number: int) -> str:
        shard, slot = divmod(number, self.layout.chunks_per_shard)
        name = self.layout.files.name(self.layout.shard(shard))
        return f"{name}: chunk {slot} (row {number * self.layout.rows_per_chunk})"


class GrowingReader(ColumnReader):
    """Reader of a column that is being written; it holds the complete chunks so far."""

    layout: ColumnLayout

    def __init__(self, layout: ColumnLayout, *, sums: bool = True) -> None:
        """Find the first shard that is not sealed; the chunks are counted by `update`.

        Without `sums` the bytes of a chunk are verified only when it is read.
        """
        super().__init__(layout)
        self.held = 0
        """Number of chunks without a gap at the last update."""
        self._sums = sums
        numbers = layout.shard_numbers()
        # No shard is begun before the previous one is full, so the others need not be read.
        ends = [n for n in numbers if layout.partial(n).exists()] + numbers[-1:]
        gaps = [index for index, number in enumerate(numbers) if number != index]
        self._number = min([*ends, *gaps], default=0)
        self._logs: dict[int, GrowingLog] = {}
        self._growing: dict[int, ShardIndex] = {}

    def update(self) -> int:
        """Read what was added and return the number of chunks without a gap."""
        self._growing.clear()
        for number in [n for n in self._logs if not self.layout.partial(n).exists()]:
            del self._logs[number]
        slots = self.layout.chunks_per_shard
        while True:
            held = self._held(self._number)
            self.held = self._number * slots + held
            if held < slots:
                return self.held
            self._number += 1

    def _held(self, number: int) -> int:
        """Return the number of complete chunks of a shard."""
        log = self._logs.get(number) or self._log(number)
        try:
            log.update()
        except FileNotFoundError:  # sealed, or not begun
            self._logs.pop(number, None)
            if not self.layout.shard(number).exists():
                return 0
            return self.layout.index(number).chunks
        self._logs[number] = log
        return len(log.records)

    def _log(self, number: int) -> GrowingLog:
        slots = self.layout.chunks_per_shard
        path = self.layout.partial(number)
        return GrowingLog(path, first_index=number * slots, limit=slots, sums=self._sums)

    def _shard_index(self, shard: int) -> ShardIndex:
        log = self._logs.get(shard)
        if log is None:
            return super()._shard_index(shard)
        if shard not in self._growing:
            self._growing[shard] = self._index_of(log)
        return self._growing[shard]

    def _index_of(self, log: GrowingLog) -> ShardIndex:
        ranges = [(record.offset, record.nbytes) for record in log.records]
        ranges += [(MISSING, MISSING)] * (self.layout.chunks_per_shard - len(ranges))
        crcs = [record.crc for record in log.records]
        return ShardIndex(ranges, crcs)

    def _path(self, shard: int) -> Path:
        # The chunks of a growing shard stay in their places when it is sealed.
        partial = self.layout.partial(shard)
        return partial if partial.exists() else self.layout.shard(shard)

    def _read(self, shard: int, numbers: list[int]) -> Iterator[Any]:
        for number in numbers:
            try:
                yield next(super()._read(shard, [number]))
            except (SessionError, FileNotFoundError):
                yield self._moved(shard, number)

    def _moved(self, shard: int, number: int) -> Any:
        """Read a chunk of a shard that its writer has replaced since its index was read.

        A resumed stream takes its last, short chunk out of the growing shard until the chunk is
        full. The sealed shard has it until the growing one takes its place.
        """
        layout, fault = self.layout, SessionError(f"{self._chunk_name(number)} is missing")
        for path in 2 * (layout.partial(shard), layout.shard(shard)):  # one may become the other
            try:
                if path == layout.shard(shard):
                    index = layout.index(shard)
                else:
                    log = self._log(shard)
                    log.update()
                    index = self._index_of(log)
                offset, nbytes = self._range(index, number)
                with path.open("rb") as file:
                    data = np.frombuffer(os.pread(file.fileno(), nbytes, offset), np.uint8)
                return self._verified(index, data, nbytes, number)
            except FileNotFoundError:
                continue
            except SessionError as error:
                fault = error if path.exists() else fault
        raise fault


# Streams that another process is writing: no lock is taken, and nothing has an effect that it could
# notice.

_ATTEMPTS = 50


@dataclass(frozen=True, slots=True)
class LiveRows:
    """Rows of a stream that is being written, or whose writer was killed."""

    rows: int
    """Number of rows that are complete in every column."""
    stored: int
    """Number of them that are stored as chunks of the small columns."""
    journalled: np.ndarray[Any, np.dtype[np.void]]
    """The others (rows - stored,), with one field per small column."""


class LiveStream:
    """A stream that is being written; `update` reads what was added since the last call."""

    def __init__(self, layout: StreamLayout) -> None:
        """Read nothing yet."""
        self.layout = layout
        self.readers = {column.column.name: GrowingReader(column) for column in layout.columns}
        self._journal = JournalReader(layout)

    def update(self) -> LiveRows:
        """Return the complete rows at this moment."""
        for _ in range(_ATTEMPTS):
            before = self.layout.journals()
            try:
                rows = self._rows(before)
            except (FileNotFoundError, SessionError):
                if self._still_has(before):
                    raise
                continue
            # A journal that was renamed meanwhile may have been read as another one.
            if self._still_has(before):
                return rows
        raise SessionError(f"{self.layout.path}: its files change faster than they can be read")

    def _still_has(self, journals: dict[int, Path]) -> bool:
        """Return True if these journals exist, or there are still none; more may have come."""
        now = self.layout.journals()
        return journals.keys() <= now.keys() and bool(journals) == bool(now)

    def _rows(self, journals: dict[int, Path]) -> LiveRows:
        layout, block = self.layout, self.layout.block
        self._journal.update(journals)
        counts = {name: reader.update() for name, reader in self.readers.items()}
        if not journals:  # closed, or never opened: the declared lengths hold
            rows = min(column.rows() for column in layout.columns)
            return LiveRows(rows, rows, np.empty(0, layout.row_dtype))
        first_row, journalled = self._journal.first_row, self._journal.rows
        stored = min(counts[column.column.name] for column in layout.small) * block
        rows = first_row + len(journalled) if stored >= first_row else stored
        if layout.image is not None:
            rows = min(rows, counts[layout.image.column.name])
        stored = min(first_row, rows)
        packed = b"".join(journalled[: rows - stored])
        return LiveRows(rows, stored, np.frombuffer(packed, layout.row_dtype))


class ImageTail:
    """The newest images of a stream that is being written."""

    def __init__(self, layout: ColumnLayout) -> None:
        """Open the column of the images, one row a chunk; `open_tail` does so by path."""
        self._reader = GrowingReader(layout, sums=False)

    def chunk(self, row: int) -> bytes | None:
        """Return the encoded image of a row, or None if it is not complete yet.

        These are the camera's original JPEG bytes if the column stores them.

        Raises:
            SessionError: The image, or its sealed shard, is corrupt.
        """
        reader, layout = self._reader, self._reader.layout
        if row >= reader.update():
            return None
        try:
            return reader.chunk(row)
        except SessionError:
            if layout.shard(row // layout.chunks_per_shard).exists():
                raise
            return None  # half written, or removed by the writer

    def jpeg(self, row: int, *, quality: int = 80) -> bytes | None:
        """Return the image of a row as JPEG, or None if it is not complete yet.

        JPEG bytes from the camera are returned unchanged; pixels are encoded at `quality`.

        Raises:
            SessionError: The image, or its sealed shard, is corrupt.
        """
        data, column = self.chunk(row), self._reader.layout.column
        if data is None or column.codec == "jpeg":
            return data
        return images.encode_jpeg(images.decoder(column)(data), quality)


def open_tail(stream: os.PathLike[str]) -> ImageTail:
    """Return the tail of the image column of the stream group at a path.

    Raises:
        SessionError: Not a stream, or one without images.
    """
    layout = StreamLayout.load(Path(stream)).image
    if layout is None:
        raise SessionError(f"{stream}: has no images")
    return ImageTail(layout)


class Table(Mapping[str, Array]):
    """Columns of a group, read on access; those used last are kept in memory."""

    def __init__(self, path: Path, files: Files = LOCAL) -> None:
        """Provide the columns of a group written by `write_table`; none if there is no group."""
        self._path, self._files = path, files
        self._names = table_columns(path, files)
        self._read: Kept[Array] = Kept()

    def __getitem__(self, name: str) -> Array:
        """Return a column (n, ...)."""
        if name not in self._names:
            raise KeyError(f"{self._path}: no column {name!r}; known: {', '.join(self._names)}")
        values = self._read.get(name)
        if values is None:
            values = self._read.put(name, self._load(name))
        return values

    def declared_rows(self, name: str) -> int:
        """Return the number of rows that a column declares, whether or not its chunks are there."""
        path = self._path / name
        shape = read_document(self._files, path / "zarr.json").get("shape")
        if not isinstance(shape, list) or not shape or type(shape[0]) is not int:
            raise SessionError(
                f"{self._files.name(path)}: found shape {shape!r:.200}, expected a list"
            )
        return shape[0]

    def _load(self, name: str) -> Array:
        return TableColumn.load(self._path / name, self._files).read()

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names."""
        return iter(self._names)

    def __len__(self) -> int:
        """Return the number of columns."""
        return len(self._names)
