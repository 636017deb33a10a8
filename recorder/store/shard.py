"""Shards that are their own write-ahead log.

While it grows, a shard is a log of records (`journal.py`) in `<key>.partial`. Sealing appends a
list of the chunks' checksums and the standard `sharding_indexed` index, whose offsets skip the
record headers, makes the file durable and renames it to its key: from then on it is a plain Zarr v3
shard. The end of a shard thus identifies all of its chunks, so a digest of it covers the file.
"""

import os
import shutil

import numpy as np

from recorder.errors import SessionError
from recorder.store.files import TEMPORARY, sync_directory
from recorder.store.journal import STEP, GrowingLog, JournalRecord, RecordLog
from recorder.store.layout import ColumnLayout, packed_index
from recorder.store.records import CRC_BYTES, HEADER, chunk_header, packed_crc


class OpenShard:
    """One growing shard of one column."""

    def __init__(self, layout: ColumnLayout, number: int, records: list[JournalRecord]) -> None:
        """Open `<key>.partial`, which contains `records`, and drop everything after them."""
        self.number = number
        self._sealed = False
        self._layout = layout
        self._entries = [(record.offset, record.nbytes) for record in records]
        self._crcs = [record.crc for record in records]
        path = layout.partial(number)
        path.parent.mkdir(parents=True, exist_ok=True)
        end = records[-1].end if records else 0
        step = STEP if layout.is_image else 0
        self._log = RecordLog(path, end=end, below=layout.path, step=step)

    def __len__(self) -> int:
        """Return the number of chunks."""
        return len(self._entries)

    @property
    def full(self) -> bool:
        """True if the shard is full."""
        return len(self._entries) == self._layout.chunks_per_shard

    def append(self, chunk: bytes, t_ns: int) -> None:
        """Add one encoded chunk."""
        index = self.number * self._layout.chunks_per_shard + len(self._entries)
        crc = packed_crc(chunk)
        head = chunk_header(len(chunk), crc, t_ns, index)
        offset = self._log.append(head, chunk, crc)
        self._entries.append((offset, len(chunk) + CRC_BYTES))
        self._crcs.append(int.from_bytes(crc, "little"))

    def drop_last(self) -> None:
        """Remove the last chunk."""
        offset, _ = self._entries.pop()
        del self._crcs[len(self._entries) :]
        self._log.truncate(offset - HEADER.size)

    def sync(self) -> None:
        """Make its chunks survive a power failure. May be called from another thread."""
        self._log.sync()

    def seal(self) -> None:
        """Turn the log into a shard and rename it, replacing a shorter one. May be called twice."""
        if self._sealed:
            return
        self._log.finish(_shard_end(self._layout, self._entries, self._crcs))
        final = self._layout.shard(self.number)
        self._log.path.replace(final)
        sync_directory(final.parent)
        self._log.close()
        self._sealed = True

    def close(self) -> None:
        """Close the file without sealing it."""
        self._log.close()


def _shard_end(layout: ColumnLayout, entries: list[tuple[int, int]], crcs: list[int]) -> bytes:
    """Return the end of a shard: checksums of its chunks, 0 for a missing one, then the index."""
    listed = np.zeros(layout.chunks_per_shard, "<u4")
    listed[: len(crcs)] = crcs[: len(listed)]
    return listed.tobytes() + packed_index(entries, layout.chunks_per_shard)


def scan_partial(layout: ColumnLayout, number: int) -> tuple[list[JournalRecord], int]:
    """Return the complete records of a growing shard and the number of torn bytes after them."""
    slots = layout.chunks_per_shard
    log = GrowingLog(layout.partial(number), first_index=number * slots, limit=slots)
    log.update()
    tail = log.tail(log.end)
    # A writer that died between index and rename leaves the index at the end; nothing is torn.
    entries = [(record.offset, record.nbytes) for record in log.records]
    end = _shard_end(layout, entries, [record.crc for record in log.records])
    return log.records, 0 if end.startswith(tail) else len(tail)


def reopen(layout: ColumnLayout, number: int, chunks: int) -> OpenShard:
    """Open a shard for appending after its first `chunks` chunks, which must exist.

    A sealed shard is not moved; its chunks are copied, and it is replaced when the copy is sealed.
    """
    partial, sealed = layout.partial(number), layout.shard(number)
    records = scan_partial(layout, number)[0] if partial.exists() else []
    if len(records) < chunks and sealed.exists():
        _copy_records(layout, number, chunks)
        records = scan_partial(layout, number)[0]
    if len(records) < chunks:
        raise SessionError(f"{partial}: {len(records)} whole records, expected {chunks}")
    return OpenShard(layout, number, records[:chunks])


def _copy_records(layout: ColumnLayout, number: int, chunks: int) -> None:
    sealed, partial = layout.shard(number), layout.partial(number)
    end = sum(layout.index(number).ranges[chunks - 1])
    temporary = partial.with_name(partial.name + TEMPORARY)
    with sealed.open("rb") as source, temporary.open("wb") as copy:
        rest = end
        while rest and (data := source.read(min(rest, 1 << 22))):
            copy.write(data)
            rest -= len(data)
        copy.flush()
        os.fsync(copy.fileno())
    # Only a complete copy may be named partial: from here on it replaces the sealed shard.
    temporary.replace(partial)
    sync_directory(partial.parent)


class ColumnLog:
    """Writer that appends encoded chunks to a column and seals its shards.

    The array's declared length grows only after a shard is sealed, so all data that a Zarr reader
    may access exists.
    """

    def __init__(self, layout: ColumnLayout, chunks: int) -> None:
        """Open the column after its first `chunks` chunks and drop any later ones."""
        self.layout = layout
        self.chunks = chunks
        self._shard: OpenShard | None = None
        number, held = divmod(chunks, layout.chunks_per_shard)
        for other in layout.shard_numbers():
            if other < number and layout.partial(other).exists():
                self.seal([reopen(layout, other, layout.chunks_per_shard)])
            elif other > number:
                layout.partial(other).unlink(missing_ok=True)
        if held:
            self._shard = reopen(layout, number, held)
        else:
            layout.partial(number).unlink(missing_ok=True)

    def append(self, chunk: bytes, t_ns: int) -> None:
        """Add one encoded chunk, whose last sample is from `t_ns`."""
        if self._shard is None:
            self._shard = OpenShard(self.layout, self.chunks // self.layout.chunks_per_shard, [])
        self._shard.append(chunk, t_ns)
        self.chunks += 1

    def drop_last(self) -> None:
        """Remove the chunk that was appended last."""
        if self._shard is not None and len(self._shard):
            self._shard.drop_last()
            self.chunks -= 1

    @property
    def full(self) -> bool:
        """True if the open shard is full."""
        return self._shard is not None and self._shard.full

    def take_full(self) -> OpenShard | None:
        """Return the open shard if it is full and detach it; the next chunk starts another."""
        if not self.full:
            return None
        shard, self._shard = self._shard, None
        return shard

    def seal(self, shards: list[OpenShard]) -> None:
        """Seal full shards of this column, then extend the array's length to include them."""
        for shard in shards:
            shard.seal()
        rows = (shards[-1].number + 1) * self.layout.rows_per_shard
        self.layout.set_rows(max(rows, self.layout.rows()))

    def seal_full(self) -> None:
        """Seal the open shard if it is full. May be repeated after an error."""
        if self._shard is not None and self._shard.full:
            self.seal([self._shard])
            self._shard = None

    def sync(self) -> None:
        """Make all appended chunks survive a power failure. May be called from another thread."""
        shard = self._shard
        if shard is not None:
            shard.sync()

    def finish(self, rows: int) -> None:
        """Seal the open shard and set the array's length to `rows`."""
        if self._shard is not None:
            self._shard.seal()
            self._shard = None
        self.layout.set_rows(rows)
        self._remove_behind(-(-rows // self.layout.rows_per_shard))

    def close(self) -> None:
        """Close the open shard without sealing it. May be called twice."""
        if self._shard is not None:
            self._shard.close()
            self._shard = None

    def _remove_behind(self, shards: int) -> None:
        for number in self.layout.shard_numbers():
            if number < shards:
                continue
            self.layout.partial(number).unlink(missing_ok=True)
            self.layout.shard(number).unlink(missing_ok=True)
            if self.layout.column.shape:
                shutil.rmtree(self.layout.path / "c" / str(number))
