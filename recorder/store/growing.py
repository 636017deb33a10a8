"""Read the files of a stream while another process appends to them.

No lock is taken, and nothing has an effect that the writer could notice.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from recorder.errors import SessionError
from recorder.store import images
from recorder.store.journal import JournalReader
from recorder.store.layout import ColumnLayout, StreamLayout
from recorder.store.reader import GrowingReader

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
