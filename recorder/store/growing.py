"""Read the files of a stream while another process appends to them.

No lock is taken, and nothing has an effect that the writer could notice.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from recorder.errors import SessionError
from recorder.store import images
from recorder.store.array import MISSING, ShardIndex
from recorder.store.journal import GrowingLog, JournalReader
from recorder.store.layout import Layout, StreamLayout
from recorder.store.reader import ColumnReader

_ATTEMPTS = 50


class GrowingReader(ColumnReader):
    """Reader of a column that is being written; it holds the complete chunks so far."""

    layout: Layout

    def __init__(self, layout: Layout, *, sums: bool = True) -> None:
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
        gaps = [place for place, number in enumerate(numbers) if number != place]
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
        layout, fault = self.layout, SessionError(f"{self._where(number)} is missing")
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

    def __init__(self, layout: Layout) -> None:
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
