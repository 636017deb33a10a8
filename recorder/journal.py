"""The row journal: one record per row, until a block of rows is stored as chunks.

A chunk per sample would make every plain reader crawl, a sample that waits in memory for its chunk
would be lost in a crash. So each row is first appended here, all small columns of the stream in one
record, and a whole block later becomes one chunk per column.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from recorder import images
from recorder.durable import replace_file
from recorder.layout import Layout, StreamLayout
from recorder.records import HEADER, RecordLog, header, scan


class Journal:
    """The open journal of a stream: the rows from `first_row` on, at most one block."""

    def __init__(self, layout: StreamLayout, first_row: int, rows: list[bytes]) -> None:
        """Open the journal that starts at a row and holds `rows`; drop what lies behind them."""
        self.first_row = first_row
        self.rows = rows
        self.path = layout.journal(first_row)
        self._block = layout.block
        width = HEADER.size + layout.row_dtype.itemsize
        self._log = RecordLog(self.path, end=width * len(rows))

    @property
    def full(self) -> bool:
        """Whether it holds a whole block."""
        return len(self.rows) == self._block

    def append(self, row: bytes, t_ns: int) -> None:
        """Add one packed row. With this the row exists.

        Raises:
            OSError: It could not be written whole; the journal is as before.
        """
        self._log.append(row, t_ns, self.first_row + len(self.rows))
        self.rows.append(row)

    def sync(self) -> None:
        """Make its rows survive a power cut. May be called from another thread."""
        self._log.sync()

    def close(self) -> None:
        """Let go of the file. Safe twice."""
        self._log.close()

    def remove(self) -> None:
        """Delete the file: its rows are stored as chunks, durably."""
        self._log.close()
        self.path.unlink(missing_ok=True)


@dataclass(frozen=True, slots=True)
class JournalledRows:
    """What the journals of a stream hold."""

    first_row: int
    """Row of the stream that `rows` starts with."""
    rows: list[bytes]
    """Packed rows, all whole."""
    paths: tuple[Path, ...]
    """All journal files, also those whose rows do not follow on."""
    torn_bytes: int
    """Bytes that belong to no row."""


def read_journals(layout: StreamLayout) -> JournalledRows | None:
    """Return the rows that are journalled, or None without a journal."""
    found = sorted(
        (int(path.name.removeprefix("journal-")), path)
        for path in layout.time.path.glob("journal-*")
        if path.name.removeprefix("journal-").isdecimal()
    )
    if not found:
        return None
    rows: list[bytes] = []
    torn = 0
    first_row = found[0][0]
    for first, path in found:
        data = path.read_bytes()
        end = 0
        if first == first_row + len(rows):  # otherwise the journal before it is torn
            for record in scan(data, first_index=first, limit=layout.block):
                rows.append(data[record.offset : record.end])
                end = record.end
        torn += len(data) - end
    return JournalledRows(first_row, rows, tuple(path for _, path in found), torn)


def write_journal(layout: StreamLayout, first_row: int, rows: list[bytes]) -> None:
    """Write a journal at once, durably."""
    records = []
    for index, row in enumerate(rows, first_row):
        records += [header(row, row_time(row), index), row]
    replace_file(layout.journal(first_row), b"".join(records))


def row_time(row: bytes) -> int:
    """Return the time of a packed row [ns]: its last eight bytes."""
    return int.from_bytes(row[-8:], "little", signed=True)


def pack_block(layout: StreamLayout, rows: list[bytes]) -> list[bytes]:
    """Return one encoded chunk per small column; a short block is padded with fill values."""
    table = np.frombuffer(b"".join(rows), layout.row_dtype)
    chunks = []
    for column in layout.small:
        chunk = np.full(column.chunk_shape, fill_value(column), column.dtype)
        chunk[: len(rows)] = table[column.column.name]
        chunks.append(images.compress(chunk.data.cast("B")))
    return chunks


def fill_value(column: Layout) -> float | int:
    """Return what a Zarr reader finds where nothing is stored."""
    return np.nan if column.dtype.kind == "f" else 0


def remove_journals(paths: tuple[Path, ...], *, keep: Path | None = None) -> None:
    """Delete journals, in order of their rows, whose rows are stored elsewhere.

    In this order what a crash leaves behind is still a row of journals without a hole, which
    starts no later than the chunks end.
    """
    for path in paths:
        if path != keep:
            path.unlink(missing_ok=True)
