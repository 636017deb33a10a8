"""Read the chunks of one column directly from its shards, local or remote.

The checksum of every chunk is verified. A chunk that is declared but missing is an error here; a
plain Zarr reader returns fill values.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import groupby
from typing import Any

import google_crc32c
import numpy as np

from recorder.errors import SessionError
from recorder.store import images
from recorder.store.growing import GrowingColumn, index_now
from recorder.store.journal import CRC_BYTES
from recorder.store.layout import Layout, decoded_rows
from recorder.store.recent import RECENT, Kept
from recorder.store.shard import MISSING, ShardIndex, read_shard_index

Array = np.ndarray[Any, Any]

# Chunks fetched concurrently from a remote store: hides latency and limits memory.
_BATCH = 16
# Memory of one entry of a shard's index, as Python's numbers [bytes].
_ENTRY_BYTES = 200


class ColumnReader:
    """Reader of one column's chunks.

    It holds no file open and no data of its own, so that it can be forked, pickled and copied, and
    thousands of readers cost little: what was read last is kept by `recent.RECENT`, within a limit
    that all readers of the process share.
    """

    def __init__(self, layout: Layout) -> None:
        """Read the declared length; shards are opened only when needed."""
        self.layout = layout
        self.rows = layout.rows()
        self.growing: GrowingColumn | None = None
        """Shards that are still growing, to be read too; set before the first read."""
        self._local = layout.files.local
        self._indices: Kept[ShardIndex] = Kept()
        self._decoded: Kept[Array] = Kept()

    def chunk(self, number: int) -> bytes:
        """Return an encoded chunk, without its checksum."""
        return next(self.chunks([number]))

    def chunks(self, numbers: Sequence[int]) -> Iterator[bytes]:
        """Yield encoded chunks; from a remote store several are fetched concurrently."""
        for data in self._verified_chunks(numbers):
            yield bytes(data)

    def read_images(self, rows: Sequence[int], out: Array) -> None:
        """Decode images into `out` (n, h, w, channels), each of them once.

        Args:
            rows: Rows of the images (n,); nothing is written for a row below 0.
            out: Destination, contiguous; of the column's shape and little-endian type.
        """
        decode = images.decoder_into(self.layout.column)
        first = {row: place for place, row in reversed(list(enumerate(rows))) if row >= 0}
        wanted = sorted(first)
        for row, data in zip(wanted, self._verified_chunks(wanted), strict=True):
            try:
                decode(data, out[first[row]])
            except SessionError as error:
                raise SessionError(f"{self._where(row)}: {error}") from error
        for place, row in enumerate(rows):
            if row >= 0 and first[row] != place:
                out[place] = out[first[row]]

    def rows_between(self, start: int, stop: int) -> Array:
        """Return rows [start, stop) (n, ...) of a small column, reading only their chunks."""
        step, per_shard = self.layout.rows_per_chunk, self.layout.chunks_per_shard
        stop = min(stop, self.rows)
        numbers = range(start // step, -(-stop // step)) if stop > start else range(0)
        for number in numbers[::per_shard]:  # the shards exist before memory is allocated
            self._shard_index(number // per_shard)
        out = np.empty((max(stop - start, 0), *self.layout.column.shape), self.layout.dtype)
        for number, rows in self._decoded_chunks(numbers):
            low, high = max(start, number * step), min(stop, (number + 1) * step)
            out[low - start : high - start] = rows[low - number * step : high - number * step]
        return out

    def read(self) -> Array:
        """Return all rows (n, ...) of a small column."""
        return self.rows_between(0, self.rows)

    def gathered(self, numbers: Array) -> Array:
        """Return the rows with the given numbers (n, ...), reading only their chunks."""
        chunk, within = np.divmod(numbers, self.layout.rows_per_chunk)
        out = np.empty((len(numbers), *self.layout.column.shape), self.layout.dtype)
        for number, rows in self._decoded_chunks(np.unique(chunk).tolist()):
            here = chunk == number
            out[here] = rows[within[here]]
        return out

    def _decoded_chunks(self, numbers: Sequence[int]) -> Iterator[tuple[int, Array]]:
        """Yield chunks of a small column with their rows, in order; fill values included."""
        many = len(numbers) * self.layout.chunk_bytes > RECENT.limit // 4
        known = {} if many else {number: self._decoded.get(number) for number in numbers}
        missing = [number for number in numbers if known.get(number) is None]
        fetched = self._verified_chunks(missing)
        for number in numbers:
            rows = known.get(number)
            if rows is None:
                rows = decoded_rows(self.layout, next(fetched))
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
        held = [n for n in numbers if self.growing is None or self._is_held(index, n)]
        wanted = {number: self._range(index, number) for number in held}
        fd = self._opened(shard)
        try:
            size = os.fstat(fd).st_size  # of a range beyond it nothing is allocated
            length = min(max((nbytes for _, nbytes in wanted.values()), default=0), size)
            buffer: Any = np.empty(length, np.uint8)
            for number in numbers:
                if number not in wanted:
                    yield self._moved(shard, number)
                    continue
                offset, nbytes = wanted[number]
                found = os.preadv(fd, [buffer[:nbytes]], offset) if offset < size else 0
                try:
                    data = self._verified(index, buffer[:found], nbytes, number)
                except SessionError:
                    if self.growing is None:
                        raise
                    data = self._moved(shard, number)
                yield data
        finally:
            os.close(fd)

    def _moved(self, shard: int, number: int) -> Any:
        """Read a chunk of a shard that its writer has replaced since its index was read.

        A resumed stream takes its last, short chunk out of the growing shard until the chunk is
        full. The sealed shard has it until the growing one takes its place.
        """
        layout, fault = self.layout, SessionError(f"{self._where(number)} is missing")
        places = ((layout.partial(shard), index_now), (layout.shard(shard), read_shard_index))
        for path, read_index in 2 * places:  # one may become the other meanwhile
            try:
                index = read_index(layout, shard)
                offset, nbytes = self._range(index, number)
                with path.open("rb") as file:
                    file.seek(offset)
                    data = np.frombuffer(file.read(nbytes), np.uint8)
                return self._verified(index, data, nbytes, number)
            except FileNotFoundError:
                continue
            except SessionError as error:
                fault = error if path.exists() else fault
        raise fault

    def _is_held(self, index: ShardIndex, number: int) -> bool:
        return index.ranges[number % self.layout.chunks_per_shard][0] != MISSING

    def _opened(self, shard: int) -> int:
        # The chunks of a growing shard stay in their places when it is sealed.
        if self.growing is not None:
            with suppress(FileNotFoundError):
                return os.open(self.layout.partial(shard), os.O_RDONLY)
        return os.open(self.layout.shard(shard), os.O_RDONLY)

    def _fetched(self, shard: int, numbers: list[int]) -> Iterator[Any]:
        index, files, path = self._shard_index(shard), self.layout.files, self.layout.shard(shard)
        wanted = [self._range(index, number) for number in numbers]
        fetched = files.ranges(path, wanted)
        for number, (_, nbytes), data in zip(numbers, wanted, fetched, strict=True):
            yield self._verified(index, data, nbytes, number)

    def _range(self, index: ShardIndex, number: int) -> tuple[int, int]:
        """Return the offset and the length of a chunk."""
        offset, nbytes = index.ranges[number % self.layout.chunks_per_shard]
        if not self._is_held(index, number):
            raise SessionError(f"{self._where(number)} is missing")
        return offset, nbytes

    def _shard_index(self, shard: int) -> ShardIndex:
        growing = None if self.growing is None else self.growing.index(shard)
        if growing is not None:
            return growing
        nbytes = _ENTRY_BYTES * self.layout.chunks_per_shard
        index = self._indices.get(shard, nbytes)
        if index is None:
            index = self._indices.put(shard, read_shard_index(self.layout, shard), nbytes)
        return index

    def _verified(self, index: ShardIndex, data: Any, nbytes: int, number: int) -> Any:
        if len(data) != nbytes:
            fault = "is cut short"
        else:
            listed = index.crcs[number % self.layout.chunks_per_shard]
            chunk, end = data[:-CRC_BYTES], data[-CRC_BYTES:]
            if google_crc32c.value(chunk) == listed == int.from_bytes(end, "little"):
                return chunk
            fault = "does not match its checksum"
        raise SessionError(f"{self._where(number)} {fault}")

    def _where(self, number: int) -> str:
        shard, place = divmod(number, self.layout.chunks_per_shard)
        name = self.layout.files.name(self.layout.shard(shard))
        return f"{name}: chunk {place} (row {number * self.layout.rows_per_chunk})"


class LazyRows:
    """Rows of a small column that are read on first use.

    Indexed like the array that they replace.
    """

    def __init__(self, reader: ColumnReader, rows: slice) -> None:
        """Replace `reader.read()[rows]`, with `rows` without a step."""
        self._reader = reader
        self._first, stop, _ = rows.indices(reader.rows)
        self.shape = (max(stop - self._first, 0), *reader.layout.column.shape)

    def __len__(self) -> int:
        """Return the number of rows."""
        return self.shape[0]

    def __getitem__(self, key: Any) -> Array:
        """Return an indexed part: rows by slice, numbers or mask, then the other axes."""
        rows, rest = (key[0], key[1:]) if isinstance(key, tuple) else (key, ())
        numbers = np.arange(len(self))[rows]
        out = self._reader.gathered(np.atleast_1d(numbers) + self._first)
        picked: Array = out[(slice(None), *rest)]
        return picked if np.ndim(numbers) else picked[0]
