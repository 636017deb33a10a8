"""Read the chunks of one column directly from its shards, local or remote.

A chunk that is declared but missing is an error here; a plain Zarr reader returns fill values.
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
from recorder.store.layout import CHUNKS_PER_SHARD, Layout, decoded_rows
from recorder.store.shard import MISSING, Index, read_index

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
        self._indices: dict[int, Index] = {}

    def chunk(self, number: int) -> bytes:
        """Return an encoded chunk.

        Raises:
            SessionError: It is missing or truncated.
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
        if len(data) != nbytes:
            raise SessionError(f"{path}: chunk {place} is cut short")
        return data

    def chunks(self, numbers: Sequence[int]) -> Iterator[bytes]:
        """Yield encoded chunks; from a remote store several are fetched concurrently.

        Raises:
            SessionError: One is missing or truncated.
        """
        if self._local:
            yield from map(self.chunk, numbers)
            return
        for first in range(0, len(numbers), _BATCH):
            batch = numbers[first : first + _BATCH]
            for shard, of_shard in groupby(batch, lambda number: number // CHUNKS_PER_SHARD):
                yield from self._fetched(shard, [n % CHUNKS_PER_SHARD for n in of_shard])

    def rows_between(self, start: int, stop: int) -> Array:
        """Return rows [start, stop) (n, ...) of a small column, reading only their chunks.

        Raises:
            SessionError: A chunk is missing or corrupt.
        """
        step = self.layout.rows_per_chunk
        stop = min(stop, self.rows)
        out = np.empty((max(stop - start, 0), *self.layout.column.shape), self.layout.dtype)
        numbers = range(start // step, -(-stop // step)) if stop > start else range(0)
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
        if shard not in self._indices:
            self._indices[shard] = read_index(path, self.layout.files)
        offset, nbytes = (int(value) for value in self._indices[shard][place])
        if offset == MISSING:
            raise SessionError(f"{self.layout.files.name(path)}: chunk {place} is missing")
        return offset, nbytes

    def _fetched(self, shard: int, places: list[int]) -> Iterator[bytes]:
        files, path = self.layout.files, self.layout.shard(shard)
        wanted = [self._range(path, shard, place) for place in places]
        for place, (_, nbytes), data in zip(
            places, wanted, files.ranges(path, wanted), strict=True
        ):
            if len(data) != nbytes:
                raise SessionError(f"{files.name(path)}: chunk {place} is cut short")
            yield data


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
