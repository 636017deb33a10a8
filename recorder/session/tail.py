"""Read a stream while it is being written: its rows so far, or single images for a live viewer.

No lock is taken, and nothing has an effect that the writer could notice.
"""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from recorder.errors import SessionError
from recorder.store import images
from recorder.store.column import ColumnReader
from recorder.store.growing import GrowingColumn, GrowingLog
from recorder.store.journal import CHUNK_MAGIC, CRC_BYTES, HEADER, record_matches
from recorder.store.layout import Layout, StreamLayout
from recorder.store.shard import MISSING, read_shard_index


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
        self.columns = {layout_.column.name: GrowingColumn(layout_) for layout_ in layout.columns}
        self._journals: dict[Path, GrowingLog] = {}

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
        found = self.layout.journals()
        return journals.keys() <= found.keys() and bool(journals) == bool(found)

    def _rows(self, journals: dict[int, Path]) -> LiveRows:
        layout, block = self.layout, self.layout.block
        if not journals:  # closed, or never opened: the declared lengths hold
            rows = min(column.rows() for column in layout.columns)
            for column in self.columns.values():
                column.update()  # the shards that grew are sealed
            return LiveRows(rows, rows, np.empty(0, layout.row_dtype))
        first_row, journalled = min(journals), self._journalled(journals)
        counts = {name: column.update() for name, column in self.columns.items()}
        stored = min(counts[column.column.name] for column in layout.small) * block
        rows = first_row + len(journalled) if stored >= first_row else stored
        if layout.image is not None:
            rows = min(rows, counts[layout.image.column.name])
        stored = min(first_row, rows)
        packed = b"".join(journalled[: rows - stored])
        return LiveRows(rows, stored, np.frombuffer(packed, layout.row_dtype))

    def _journalled(self, journals: dict[int, Path]) -> list[bytes]:
        """Return the packed rows of the journals, up to the first gap."""
        self._journals = {
            path: self._journals.get(path)
            or GrowingLog(path, first_index=first, limit=self.layout.block, payloads=True)
            for first, path in sorted(journals.items())
        }
        start, rows = min(journals), list[bytes]()
        for first, path in sorted(journals.items()):
            log = self._journals[path]
            log.update()
            if first == start + len(rows):  # otherwise the journal before it is torn
                rows += log.payloads
        return rows


_ATTEMPTS = 50


class ImageTail:
    """The newest images of one growing column, as a context manager.

    Args:
        layout: The image column, one row a chunk.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._fd = -1
        self._number = -1
        self._offsets: list[int] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def chunk(self, row: int) -> bytes | None:
        """Return the encoded image of a row, or None if it is not complete yet.

        These are the camera's original JPEG bytes if the column stores them.

        Raises:
            SessionError: The row's shard is sealed and corrupt.
        """
        number, place = divmod(row, self._layout.chunks_per_shard)
        if self._layout.partial(number).exists():
            data = self._from_open(number, place, row)
            if data is not None:
                return data
        # Either just sealed, or not written yet.
        if not self._layout.shard(number).exists():
            return None
        if read_shard_index(self._layout, number).entries[place, 0] == MISSING:
            return None
        return ColumnReader(self._layout).chunk(row)

    def jpeg(self, row: int, *, quality: int = 80) -> bytes | None:
        """Return the image of a row as JPEG, or None if it is not complete yet.

        JPEG bytes from the camera are returned unchanged; pixels are encoded at `quality`.

        Raises:
            SessionError: The image, or its sealed shard, is corrupt.
        """
        data = self.chunk(row)
        if data is None or self._layout.column.codec == "jpeg":
            return data
        return images.encode_jpeg(images.decoder(self._layout.column)(data), quality)

    def close(self) -> None:
        """Close the file. May be called twice."""
        if self._fd >= 0:
            os.close(self._fd)
        self._fd, self._number = -1, -1
        self._offsets = []

    def _from_open(self, number: int, place: int, row: int) -> bytes | None:
        if number != self._number:
            self.close()
            try:
                self._fd = os.open(self._layout.partial(number), os.O_RDONLY)
            except FileNotFoundError:
                return None
            self._number, self._offsets = number, [0]
        while len(self._offsets) <= place:
            end = self._end_of_record(self._offsets[-1])
            if end is None:
                return None
            self._offsets.append(end)
        head = os.pread(self._fd, HEADER.size, self._offsets[place])
        if len(head) < HEADER.size:
            return None
        data = os.pread(self._fd, HEADER.unpack(head)[1], self._offsets[place] + HEADER.size)
        if record_matches(head, data, row):
            return data[:-CRC_BYTES]
        # Half written, or the writer removed a record: start again on the next call.
        self.close()
        return None

    def _end_of_record(self, offset: int) -> int | None:
        head = os.pread(self._fd, HEADER.size, offset)
        if len(head) < HEADER.size or head[:4] != CHUNK_MAGIC:
            return None
        return offset + HEADER.size + int(HEADER.unpack(head)[1])


def open_tail(stream: os.PathLike[str]) -> ImageTail:
    """Return the tail of the image column of the stream group at a path.

    Raises:
        SessionError: Not a stream, or one without images.
    """
    layout = StreamLayout.load(Path(stream)).image
    if layout is None:
        raise SessionError(f"{stream}: has no images")
    return ImageTail(layout)
