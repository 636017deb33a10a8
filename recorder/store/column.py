"""Read the chunks of one column directly from its shards, local or remote.

The checksum of every chunk is verified. A chunk that is declared but missing is an error here; a
plain Zarr reader returns fill values.
"""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from recorder.errors import SessionError
from recorder.store.journal import CRC_BYTES, HEADER, ends_with_its_crc, record_matches
from recorder.store.layout import CHUNKS_PER_SHARD, Layout, decoded_rows
from recorder.store.shard import MISSING, ShardIndex, read_shard_index

Array = np.ndarray[Any, Any]

# Chunks fetched concurrently from a remote store: hides latency and limits memory.
_BATCH = 16
# Number of decoded chunks that `LazyRows` caches.
_KEPT = 64


class ColumnReader:
    """Reader of one column's chunks.

    It holds no file open, so that it can be forked, pickled and copied.
    """

    def __init__(self, layout: Layout) -> None:
        """Read the declared length; shards are opened only when needed."""
        self.layout = layout
        self.rows = layout.rows()
        self._local = layout.files.local
        self._indices: dict[int, ShardIndex] = {}

    def chunk(self, number: int) -> bytes:
        """Return an encoded chunk, without its checksum.

        Raises:
            SessionError: It is missing, truncated or corrupt.
        """
        if not self._local:
            return next(self.chunks([number]))
        shard, place = divmod(number, CHUNKS_PER_SHARD)
        path = self.layout.shard(shard)
        offset, nbytes = self._range(path, shard, place)
        fd = os.open(path, os.O_RDONLY)
        try:
            data = os.pread(fd, nbytes, offset)
        finally:
            os.close(fd)
        return self._verified(data, nbytes, number)

    def chunks(self, numbers: Sequence[int]) -> Iterator[bytes]:
        """Yield encoded chunks; from a remote store several are fetched concurrently.

        Raises:
            SessionError: One is missing, truncated or corrupt.
        """
        if self._local:
            yield from map(self.chunk, numbers)
            return
        for first in range(0, len(numbers), _BATCH):
            batch = numbers[first : first + _BATCH]
            for shard, of_shard in groupby(batch, lambda number: number // CHUNKS_PER_SHARD):
                yield from self._fetched(shard, list(of_shard))

    def rows_between(self, start: int, stop: int) -> Array:
        """Return rows [start, stop) (n, ...) of a small column, reading only their chunks.

        Raises:
            SessionError: A chunk is missing or corrupt.
        """
        step = self.layout.rows_per_chunk
        stop = min(stop, self.rows)
        numbers = range(start // step, -(-stop // step)) if stop > start else range(0)
        for number in numbers[::CHUNKS_PER_SHARD]:  # the shards exist before memory is allocated
            self._shard_index(number // CHUNKS_PER_SHARD)
        out = np.empty((max(stop - start, 0), *self.layout.column.shape), self.layout.dtype)
        for number, data in zip(numbers, self.chunks(numbers), strict=True):
            low, high = max(start, number * step), min(stop, (number + 1) * step)
            rows = decoded_rows(self.layout, data)
            out[low - start : high - start] = rows[low - number * step : high - number * step]
        return out

    def read(self) -> Array:
        """Return all rows (n, ...) of a small column.

        Raises:
            SessionError: A chunk is missing or corrupt.
        """
        return self.rows_between(0, self.rows)

    def _range(self, path: Path, shard: int, place: int) -> tuple[int, int]:
        """Return the bytes to read for a chunk: with its record header if only this has a CRC."""
        offset, nbytes = (int(value) for value in self._shard_index(shard).entries[place])
        if offset == MISSING:
            raise SessionError(f"{self.layout.files.name(path)}: chunk {place} is missing")
        if self.layout.chunk_crc:
            return offset, nbytes
        if offset < HEADER.size:
            raise SessionError(f"{self.layout.files.name(path)}: chunk {place} has no record")
        return offset - HEADER.size, nbytes + HEADER.size

    def _shard_index(self, shard: int) -> ShardIndex:
        if shard not in self._indices:
            self._indices[shard] = read_shard_index(self.layout, shard)
        return self._indices[shard]

    def _verified(self, data: bytes, nbytes: int, number: int) -> bytes:
        shard, place = divmod(number, CHUNKS_PER_SHARD)
        crcs = self._indices[shard].crcs
        if len(data) != nbytes:
            fault = "is cut short"
        elif crcs is None:
            head, chunk = data[: HEADER.size], data[HEADER.size :]
            if record_matches(head, chunk, number):
                return chunk
            fault = "does not match its checksum"
        else:
            listed = int(crcs[place]).to_bytes(CRC_BYTES, "little")
            if ends_with_its_crc(data) and data.endswith(listed):
                return data[:-CRC_BYTES]
            fault = "does not match its checksum"
        name = self.layout.files.name(self.layout.shard(shard))
        row = number * self.layout.rows_per_chunk
        raise SessionError(f"{name}: chunk {place} (row {row}) {fault}")

    def _fetched(self, shard: int, numbers: list[int]) -> Iterator[bytes]:
        files, path = self.layout.files, self.layout.shard(shard)
        wanted = [self._range(path, shard, number % CHUNKS_PER_SHARD) for number in numbers]
        fetched = files.ranges(path, wanted)
        for number, (_, nbytes), data in zip(numbers, wanted, fetched, strict=True):
            yield self._verified(data, nbytes, number)


class LazyRows:
    """Rows of a small column that are read on first use.

    Indexed like the array that they replace. The chunks read last are cached, decoded.
    """

    def __init__(self, reader: ColumnReader, rows: slice) -> None:
        """Replace `reader.read()[rows]`, with `rows` without a step."""
        self._reader = reader
        self._first, stop, _ = rows.indices(reader.rows)
        self.shape = (max(stop - self._first, 0), *reader.layout.column.shape)
        self._kept: OrderedDict[int, Array] = OrderedDict()

    def __len__(self) -> int:
        """Return the number of rows."""
        return self.shape[0]

    def __getitem__(self, key: Any) -> Array:
        """Return an indexed part: rows by slice, numbers or mask, then the other axes."""
        rows, rest = (key[0], key[1:]) if isinstance(key, tuple) else (key, ())
        numbers = np.arange(len(self))[rows]
        out = self._gathered(np.atleast_1d(numbers))
        picked: Array = out[(slice(None), *rest)]
        return picked if np.ndim(numbers) else picked[0]

    def _gathered(self, numbers: Array) -> Array:
        step = self._reader.layout.rows_per_chunk
        chunk, within = np.divmod(numbers + self._first, step)
        needed = [int(number) for number in np.unique(chunk)]
        missing = [number for number in needed if number not in self._kept]
        for number, data in zip(missing, self._reader.chunks(missing), strict=True):
            self._kept[number] = decoded_rows(self._reader.layout, data)
        out = np.empty((len(numbers), *self.shape[1:]), self._reader.layout.dtype)
        for number in needed:
            self._kept.move_to_end(number)
            here = chunk == number
            out[here] = self._kept[number][within[here]]
        while len(self._kept) > _KEPT:
            self._kept.popitem(last=False)
        return out
