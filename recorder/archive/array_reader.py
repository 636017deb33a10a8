"""Reads rows of an archive's array straight from its shards, wherever they lie.

A chunk that is declared but not there is an error here; a Zarr reader would see fill values.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.archive.array import Array, ArrayLayout
from recorder.errors import SessionError
from recorder.shard import MISSING, Index, read_index

Rows = Sequence[int] | NDArray[np.integer[Any]] | slice


class ArrayReader:
    """The rows of one array. Holds no file open, so that it may be forked, pickled and copied."""

    def __init__(self, layout: ArrayLayout) -> None:
        """Look at shards when they are needed."""
        self.layout = layout
        self._indices: dict[int, Index] = {}

    def __len__(self) -> int:
        """Return the declared number of rows."""
        return self.layout.rows

    def all(self) -> Array:
        """Return all rows (n, ...).

        Raises:
            SessionError: A chunk is missing or damaged.
        """
        return self.read(slice(None))

    def read(self, rows: Rows) -> Array:
        """Return some rows (n, ...) in the order asked for; a chunk is decoded once.

        Raises:
            SessionError: No such row, or a chunk that is missing or damaged.
        """
        numbers = self._numbers(rows)
        out = np.empty((len(numbers), *self.layout.spec.shape[1:]), self.layout.dtype)
        chunk, within = np.divmod(numbers, self.layout.spec.chunk_rows)
        order = np.argsort(chunk, kind="stable")
        wanted, first = np.unique(chunk[order], return_index=True)
        rows_of = dict(zip(wanted.tolist(), np.split(order, first[1:]), strict=False))
        for shard, group in groupby(wanted.tolist(), lambda number: number // self.layout.slots):
            chunks = list(group)
            fetched = self.fetch(shard, [number % self.layout.slots for number in chunks])
            for number, data in zip(chunks, fetched, strict=True):
                here = rows_of[number]
                out[here] = self.layout.decoded(data)[within[here]]
        return out

    def fetch(self, shard: int, places: Sequence[int]) -> list[bytes]:
        """Return encoded chunks of one shard.

        Raises:
            SessionError: The shard or a chunk is missing or cut short.
        """
        files, path = self.layout.files, self.layout.shard(shard)
        if shard not in self._indices:
            self._indices[shard] = read_index(path, files, self.layout.slots)
        wanted = [(int(offset), int(size)) for offset, size in self._indices[shard][list(places)]]
        for place, (offset, _) in zip(places, wanted, strict=True):
            if offset == MISSING:
                raise SessionError(f"{files.name(path)}: chunk {place} is missing")
        try:
            found = files.ranges(path, wanted)
        except FileNotFoundError:
            raise SessionError(f"{files.name(path)}: shard missing") from None
        for place, (_, size), data in zip(places, wanted, found, strict=True):
            if len(data) != size:
                raise SessionError(f"{files.name(path)}: chunk {place} is cut short")
        return found

    def _numbers(self, rows: Rows) -> NDArray[np.int64]:
        if isinstance(rows, slice):
            return np.arange(len(self), dtype=np.int64)[rows]
        numbers = np.asarray(rows)
        where = self.layout.files.name(self.layout.path)
        if numbers.ndim != 1 or (numbers.size and numbers.dtype.kind not in "iu"):
            raise SessionError(
                f"{where}: found rows {numbers.dtype} {numbers.shape}, expected integers (n,)"
            )
        wrong = numbers[(numbers < 0) | (numbers >= len(self))]
        if wrong.size:
            raise SessionError(f"{where}: no row {wrong[0]}, the array has {len(self)}")
        return numbers.astype(np.int64)
