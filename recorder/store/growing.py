"""Read the files of a stream while another process appends to them, each byte once.

Nothing here is locked or kept open; what was read is remembered with its place.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from recorder.store.journal import CHUNK_MAGIC, CRC_BYTES, HEADER, JournalRecord, record_matches
from recorder.store.layout import Layout
from recorder.store.shard import MISSING, ShardIndex, chunk_count, read_shard_index


class GrowingLog:
    """The complete records of a log so far."""

    def __init__(self, path: Path, *, first_index: int, limit: int, payloads: bool = False) -> None:
        """Read nothing yet.

        Args:
            path: The log.
            first_index: Number of its first record.
            limit: Largest number of records.
            payloads: True to keep the payloads.
        """
        self.path = path
        self.records: list[JournalRecord] = []
        self.payloads: list[bytes] = []
        self._first, self._limit, self._keeps = first_index, limit, payloads
        self._inode = -1
        self._last_head = b""

    def update(self) -> None:
        """Read the records that were added."""
        fd = os.open(self.path, os.O_RDONLY)
        try:
            found = os.fstat(fd)
            if found.st_ino != self._inode or not self._continues(fd):
                self.records.clear()
                self.payloads.clear()
                self._inode = found.st_ino
            while len(self.records) < self._limit and self._read_record(fd, found.st_size):
                pass
        finally:
            os.close(fd)

    def _continues(self, fd: int) -> bool:
        """Return False if the last record was removed, as on a full disk."""
        if not self.records:
            return True
        return os.pread(fd, HEADER.size, self.records[-1].offset - HEADER.size) == self._last_head

    def _read_record(self, fd: int, size: int) -> bool:
        start = (self.records[-1].end if self.records else 0) + HEADER.size
        if start > size:
            return False
        head = os.pread(fd, HEADER.size, start - HEADER.size)
        magic, nbytes, crc, t_ns, index = HEADER.unpack(head)
        if start + nbytes > size:  # torn, or no record; nothing is allocated for it
            return False
        payload = os.pread(fd, nbytes, start) if nbytes else b""
        if not record_matches(head, payload, self._first + len(self.records)):
            return False
        if magic == CHUNK_MAGIC:
            crc = int.from_bytes(payload[-CRC_BYTES:], "little")
        self.records.append(JournalRecord(index, t_ns, start, nbytes, crc))
        if self._keeps:
            self.payloads.append(payload)
        self._last_head = head
        return True


class GrowingColumn:
    """The complete chunks of a column so far."""

    def __init__(self, layout: Layout) -> None:
        """Find the first shard that is not sealed; the chunks are counted by `update`."""
        self.layout = layout
        self.chunks = 0
        numbers = layout.shard_numbers()
        # No shard is begun before the previous one is full, so the others need not be read.
        ends = [n for n in numbers if layout.partial(n).exists()] + numbers[-1:]
        gaps = [place for place, number in enumerate(numbers) if number != place]
        self._number = min([*ends, *gaps], default=0)
        self._logs: dict[int, GrowingLog] = {}
        self._indices: dict[int, ShardIndex] = {}

    def update(self) -> int:
        """Read what was added and return the number of chunks without a gap."""
        self._indices.clear()
        for number in [n for n in self._logs if not self.layout.partial(n).exists()]:
            del self._logs[number]
        slots = self.layout.chunks_per_shard
        while True:
            held = self._held(self._number)
            self.chunks = self._number * slots + held
            if held < slots:
                return self.chunks
            self._number += 1

    def index(self, number: int) -> ShardIndex | None:
        """Return the chunks of a shard that was growing at the last update; None if it was not."""
        log = self._logs.get(number)
        if log is None:
            return None
        if number not in self._indices:
            self._indices[number] = _index_of(self.layout, log)
        return self._indices[number]

    def _held(self, number: int) -> int:
        """Return the number of complete chunks of a shard."""
        log = self._logs.get(number) or _log_of(self.layout, number)
        try:
            log.update()
        except FileNotFoundError:  # sealed, or not begun
            self._logs.pop(number, None)
            if not self.layout.shard(number).exists():
                return 0
            return chunk_count(read_shard_index(self.layout, number).entries)
        self._logs[number] = log
        return len(log.records)


def index_now(layout: Layout, number: int) -> ShardIndex:
    """Return the complete chunks of a growing shard at this moment."""
    log = _log_of(layout, number)
    log.update()
    return _index_of(layout, log)


def _log_of(layout: Layout, number: int) -> GrowingLog:
    slots = layout.chunks_per_shard
    return GrowingLog(layout.partial(number), first_index=number * slots, limit=slots)


def _index_of(layout: Layout, log: GrowingLog) -> ShardIndex:
    ranges = [(record.offset, record.nbytes) for record in log.records]
    ranges += [(MISSING, MISSING)] * (layout.chunks_per_shard - len(ranges))
    return ShardIndex(np.array(ranges, np.uint64), ranges, [record.crc for record in log.records])
