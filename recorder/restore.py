"""What of a stream is there after its writer stopped, however it stopped; and how to go on.

Rows below the first journal come from the shards, the others from the journals, an image counts
only with its row and a row only with its image. Resuming and recovering are the same act: put the
stream back into the state it had while it was written, after its last whole row.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.columnlog import ColumnLog
from recorder.durable import TEMPORARY
from recorder.errors import SessionError
from recorder.journal import (
    Journal,
    JournalledRows,
    pack_block,
    read_journals,
    remove_journals,
    row_time,
    write_journal,
)
from recorder.layout import CHUNKS_PER_SHARD, PARTIAL, Layout, StreamLayout, decoded_rows
from recorder.shard import chunk_count, read_index, scan_partial

BALLAST = "ballast"
"""Room kept on the disk of a stream being written, so that a full disk can still be closed."""


@dataclass(frozen=True, slots=True)
class StreamState:
    """What a look at a stream finds, nothing being changed."""

    rows: int
    """Rows that exist whole in every column."""
    journalled: JournalledRows | None
    """Rows that are not stored as chunks yet; None when the stream was closed."""
    torn_bytes: int
    """Bytes of records that were being written when the writer died."""
    dropped_rows: int
    """Rows that some columns hold and others do not."""
    unfinished: tuple[Path, ...]
    """Files that a closed stream does not have."""


def survey(layout: StreamLayout) -> StreamState:
    """Look at a stream without changing it.

    Raises:
        SessionError: A sealed shard that is needed to count the rows is damaged.
    """
    journalled = read_journals(layout)
    if journalled is None:  # closed, or never opened: the declared lengths hold
        lengths = [column.rows() for column in layout.columns]
        return StreamState(min(lengths), None, 0, _spread(lengths), unfinished_files(layout))
    held, torn = zip(*(count_chunks(column) for column in layout.columns), strict=True)
    blocks = min(held[-len(layout.small) :])
    reach = journalled.first_row + len(journalled.rows)
    lengths = [reach if blocks * layout.block >= journalled.first_row else blocks * layout.block]
    if layout.image is not None:
        lengths.append(held[0])
    return StreamState(
        min(lengths),
        journalled,
        journalled.torn_bytes + sum(torn),
        _spread(lengths),
        unfinished_files(layout),
    )


def count_chunks(column: Layout) -> tuple[int, int]:
    """Return how many chunks a column holds without a hole, and its torn bytes."""
    chunks = torn = 0
    numbers = column.shard_numbers()
    for number in numbers:
        if column.partial(number).exists():
            records, torn_here = scan_partial(column, number)
            held = len(records)
            torn += torn_here
        elif number < numbers[-1]:  # nothing is ever begun behind a short shard
            held = CHUNKS_PER_SHARD
        else:
            held = chunk_count(read_index(column.shard(number)))
        if chunks == number * CHUNKS_PER_SHARD:
            chunks += held
    return chunks, torn


def unfinished_files(layout: StreamLayout) -> tuple[Path, ...]:
    """Return the files that only a stream being written has."""
    return tuple(sorted(p for p in layout.path.rglob("*") if is_unfinished(layout, p)))


def is_unfinished(layout: StreamLayout, path: Path) -> bool:
    """Return whether a path below a stream is one that only a stream being written has."""
    name, parent = path.name, path.parent
    if parent == layout.time.path and (name.startswith("journal-") or name == BALLAST):
        return True
    columns = [column.path for column in layout.columns]
    if name.endswith(TEMPORARY) and parent in (layout.path, *columns):
        return True
    return PARTIAL in name and any(column / "c" in path.parents for column in columns)


@dataclass(frozen=True, slots=True)
class OpenStream:
    """A stream ready to be appended to."""

    image: ColumnLog | None
    """Its images."""
    small: tuple[ColumnLog, ...]
    """Its other columns, up to the start of the journal."""
    journal: Journal
    """The rows behind them."""


def restore(layout: StreamLayout) -> OpenStream:
    """Open a stream behind its last whole row. Killed at any point, it can be called again.

    Raises:
        SessionError: The stream is damaged where it has to be read.
    """
    for path in unfinished_files(layout):
        if path.name.endswith(TEMPORARY) or path.name == BALLAST:
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
        remove_journals(state.journalled.paths, keep=journal.path)
    for column in layout.columns:
        if column.rows() > state.rows:
            column.set_rows(state.rows)
    return OpenStream(image, small, journal)


def store_block(
    layout: StreamLayout, logs: tuple[ColumnLog, ...], first_row: int, rows: list[bytes]
) -> None:
    """Append one block of rows to all small columns, sealing what is full.

    Columns that hold the block already are left alone, so it may be called again after an error.
    """
    number = first_row // layout.block
    for log, chunk in zip(logs, pack_block(layout, rows), strict=True):
        if log.chunks == number:
            log.append(chunk, row_time(rows[-1]))
        log.seal_full()


def _rows_to_journal(layout: StreamLayout, state: StreamState) -> tuple[int, list[bytes]]:
    """Return the rows that must (again) be in a journal, and make sure that they are."""
    journalled = state.journalled
    if journalled is not None and journalled.first_row <= state.rows:
        rows = journalled.rows[: state.rows - journalled.first_row]
        start = state.rows - state.rows % layout.block
        if layout.journal(start) not in journalled.paths:
            write_journal(layout, start, rows[start - journalled.first_row :])
        return journalled.first_row, rows
    start = state.rows - state.rows % layout.block
    rows = _stored_rows(layout, start, state.rows)
    write_journal(layout, start, rows)
    return start, rows


def _stored_rows(layout: StreamLayout, start: int, stop: int) -> list[bytes]:
    """Return the rows of the last, short block, packed as in a journal."""
    if start == stop:
        return []
    table = np.zeros(stop - start, layout.row_dtype)
    for column in layout.small:
        table[column.column.name] = _read_chunk(column, start // layout.block)[: stop - start]
    return [row.tobytes() for row in table]


def _spread(lengths: list[int]) -> int:
    return max(lengths) - min(lengths)


def _read_chunk(column: Layout, chunk: int) -> NDArray[Any]:
    number, place = divmod(chunk, CHUNKS_PER_SHARD)
    path = column.partial(number)
    if path.exists():
        record = scan_partial(column, number)[0][place]
        offset, nbytes = record.offset, record.nbytes
    else:
        path = column.shard(number)
        offset, nbytes = (int(value) for value in read_index(path)[place])
    with path.open("rb") as file:
        file.seek(offset)
        data = file.read(nbytes)
    if len(data) != nbytes:
        raise SessionError(f"{path}: chunk {place} is cut short")
    return decoded_rows(column, data)
